"""Environment Transformer and Conservative Q-Learning: from a log of trajectories to a world model and a policy."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from envtf_lit.registration import register_environment

if TYPE_CHECKING:
    from envtf_lit.critics import load_critics
    from envtf_lit.data.sources.files import load_dataset
    from envtf_lit.policy import load_policy
    from envtf_lit.world_models.store import load_world_model

    __version__: str

_EXPORTS = {
    "load_critics": "envtf_lit.critics",
    "load_dataset": "envtf_lit.data.sources.files",
    "load_policy": "envtf_lit.policy",
    "load_world_model": "envtf_lit.world_models.store",
}
__all__ = ["__version__", "load_critics", "load_dataset", "load_policy", "load_world_model"]

register_environment()


def __getattr__(name: str) -> Any:
    """Imports on first use, so that `import envtf_lit` and `envtf --help` need not load torch."""
    if name in _EXPORTS:
        return getattr(import_module(_EXPORTS[name]), name)
    if name == "__version__":
        return import_module("importlib.metadata").version("envtf-lit")
    raise AttributeError(f"module 'envtf_lit' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
