"""Makes `gymnasium.make("envtf/Imagined-v0")` known, without importing Gymnasium (or torch) before anyone else does."""

import sys
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from importlib.util import find_spec
from types import ModuleType
from typing import Any

ENV_ID = "envtf/Imagined-v0"


def register_environment() -> None:
    """Registers now if Gymnasium has been imported, else as soon as it is: importing it costs, and brings numpy."""
    if "gymnasium" in sys.modules:
        _register(sys.modules["gymnasium"])
    else:
        sys.meta_path.insert(0, _Waiting())


def _register(gymnasium: Any) -> None:
    if ENV_ID not in gymnasium.registry:
        home = "envtf_lit.imagination"
        gymnasium.register(
            ENV_ID, entry_point=f"{home}.env:ImaginedEnv", vector_entry_point=f"{home}.vector_env:ImaginedVectorEnv"
        )


class _Waiting(MetaPathFinder):
    """Stands before the finders of modules until Gymnasium is looked for."""

    def find_spec(self, fullname: str, path: Any = None, target: Any = None) -> ModuleSpec | None:
        if fullname != "gymnasium":
            return None
        sys.meta_path.remove(self)
        spec = find_spec(fullname)
        if spec is not None and spec.loader is not None:
            spec.loader = _Registering(spec.loader)
        return spec


class _Registering(Loader):
    """Loads Gymnasium as its own loader does, then registers."""

    def __init__(self, loader: Loader) -> None:
        self.loader = loader

    def create_module(self, spec: ModuleSpec) -> ModuleType | None:
        return self.loader.create_module(spec)

    def exec_module(self, module: ModuleType) -> None:
        spec = module.__spec__
        if spec is not None:
            spec.loader = module.__loader__ = self.loader
        self.loader.exec_module(module)
        _register(module)
