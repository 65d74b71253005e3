"""What is installed: bounds, pinned versions and their hashes, extras, and that the code imports just these."""

import ast
import json
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterable
from functools import cache
from importlib.metadata import requires, version
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from packaging.version import Version

import envtf_lit
from envtf_lit.cli.main import main
from envtf_lit.errors import UserError
from envtf_lit.pipeline.report import report
from envtf_lit.pipeline.yaml import preset_params
from envtf_lit.project.doctor import report as doctor_report

ROOT = Path(__file__).parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
EXTRAS = PROJECT["optional-dependencies"]
# modules that need more than the library's own dependencies
NEED = {
    "envtf_lit/comparison/cluster.py": "cluster",
    "envtf_lit/data/sources/parquet.py": "parquet",
    "envtf_lit/export.py": "export",
    "envtf_lit/figures/inline.py": "pipeline",
    "envtf_lit/figures/notebook.py": "pipeline",
    "envtf_lit/figures/report.py": "pipeline",
    "envtf_lit/zoo/train.py": "behaviour",
    "notebooks/07_planning.ipynb": "behaviour",
}
IMPORTED_AS = {"pillow": "PIL", "ipython": "IPython", "ruamel.yaml": "ruamel", "sbx-rl": "sbx"}
NOT_IMPORTED = {
    "dvc": "runs dvc.yaml",
    "ipykernel": "is the kernel that papermill starts",
    "jupyterlab": "opens the notebooks",
}


def dependencies(*extras: str) -> list[Requirement]:
    """The library's own, and those of extras."""
    texts = [*PROJECT["dependencies"], *(text for extra in extras for text in EXTRAS[extra])]
    return [requirement for requirement in map(Requirement, texts) if requirement.name != PROJECT["name"]]


def pins() -> dict[str, str]:
    lines = [line for line in (ROOT / "constraints.txt").read_text().splitlines() if not line.startswith("#")]
    assert [line for line in lines if not re.fullmatch(r"[\w.-]+==\d[\w.]*", line)] == []
    return {canonicalize_name(name): version for name, version in (line.split("==") for line in lines)}


def locked() -> dict[str, tuple[str, list[str]]]:
    """Each package's version and hashes in requirements.lock, which holds nothing else."""
    text = re.sub(r"^#.*\n", "", (ROOT / "requirements.lock").read_text(), flags=re.MULTILINE)
    entry = re.compile(r"([\w.-]+)==([\w.]+)(?: ; [^\\\n]*)?((?: \\\n    --hash=sha256:[0-9a-f]{64})+)\n")
    assert entry.sub("", text) == ""
    return {canonicalize_name(name): (pin, hashes.split(" \\\n")[1:]) for name, pin, hashes in entry.findall(text)}


# versions


def test_constraints_are_plain_versions_within_the_bounds() -> None:
    pinned = pins()
    for requirement in dependencies("pipeline", "behaviour", "docs", "dev"):
        assert requirement.specifier.contains(Version(pinned[canonicalize_name(requirement.name)])), requirement


def test_the_releases_of_lightning_that_stole_credentials_are_refused() -> None:
    (lightning,) = (requirement for requirement in dependencies() if requirement.name == "lightning")
    assert [v for v in ("2.6.1", "2.6.2", "2.6.3", "2.6.6") if v in lightning.specifier] == ["2.6.1", "2.6.6"]
    assert {pins()["lightning"], pins()["pytorch-lightning"], locked()["lightning"][0]}.isdisjoint({"2.6.2", "2.6.3"})


def test_the_lock_holds_the_constraints_versions() -> None:
    pinned = pins()
    assert {name: pin for name, (pin, _) in locked().items() if pinned.get(name, pin) != pin} == {}


def test_the_lock_holds_all_that_the_pipeline_asks_for_but_torch() -> None:
    pinned, lock = pins(), locked()
    seen, waiting = set(), dependencies("pipeline")
    while waiting:
        requirement = waiting.pop()
        name = canonicalize_name(requirement.name)
        if name == "torch" or (name, *requirement.extras) in seen:
            continue
        seen.add((name, *requirement.extras))
        assert name in lock, requirement
        if version(name) == pinned.get(name):  # what others ask for is no matter of the lock
            waiting += [
                asked
                for asked in map(Requirement, requires(name) or [])
                if asked.marker is None or any(asked.marker.evaluate({"extra": e}) for e in ("", *requirement.extras))
            ]
    assert len(seen) > 100  # all of Jupyter and DVC
    assert not {"torch", "triton", "nvidia-cublas"} & lock.keys()


@pytest.mark.parametrize(("constraints", "hashed"), [("constraints.txt", True), ("pyproject.toml", False), ("", False)])
def test_hashes_are_asked_of_the_pinned_versions_alone(constraints: str, hashed: bool) -> None:
    make = ["make", "--dry-run", "--always-make", f"CONSTRAINTS={constraints}", "repro"]
    shown = subprocess.run(make, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    assert ("--require-hashes --no-deps --requirement requirements.lock" in shown) == hashed
    assert (f"--constraint {constraints}" in shown) == bool(constraints)
    assert "--editable '.[pipeline]'" in shown


# imports


def third_party(code: str) -> set[str]:
    """The top-level packages that source code imports, at any place, less Python's own and this one."""
    names = set()
    for node in ast.walk(ast.parse(code)):
        if isinstance(node, ast.Import):
            names |= {alias.name.partition(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            names.add(str(node.module).partition(".")[0])
    return names - sys.stdlib_module_names - {"envtf_lit"}


@cache
def imported() -> dict[str, set[str]]:
    """By module or notebook."""
    sources = {
        str(path.relative_to(ROOT)): third_party(path.read_text()) for path in (ROOT / "envtf_lit").rglob("*.py")
    }
    for path in (ROOT / "notebooks").glob("*.ipynb"):
        cells = json.loads(path.read_text())["cells"]
        code = ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]
        sources[str(path.relative_to(ROOT))] = third_party("\n".join(code))
    return sources


def provided(requirements: Iterable[Requirement]) -> set[str]:
    return {IMPORTED_AS.get(r.name, r.name.replace("-", "_")) for r in requirements}


@pytest.mark.parametrize("source", sorted(imported()))
def test_a_module_imports_what_its_installation_brings(source: str) -> None:
    extras = ["pipeline"] * source.startswith("notebooks") + [extra for extra in [NEED.get(source)] if extra]
    assert imported()[source] <= provided(dependencies(*extras))


def test_every_dependency_is_imported_or_has_another_use() -> None:
    used = set().union(*imported().values())
    idle = {r.name for r in dependencies("pipeline", "behaviour") if not provided([r]) & used}
    assert idle == set(NOT_IMPORTED)


# what is missing or broken


def block(monkeypatch: pytest.MonkeyPatch, *names: str) -> None:
    """Lets imports of these fail as if they were not installed."""
    monkeypatch.delitem(sys.modules, "envtf_lit.figures.notebook", raising=False)
    for name in names:
        monkeypatch.setitem(sys.modules, name, None)


def test_the_report_without_its_extra_names_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    block(monkeypatch, "papermill")
    with pytest.raises(UserError, match=r"needs papermill .*: pip install 'envtf-lit\[pipeline\]'\.$"):
        report(preset_params("tiny"), tmp_path)
    assert not list(tmp_path.iterdir())


def test_init_says_how_to_get_dvc(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    main(["init", str(tmp_path / "with")])
    assert "pip install" not in capsys.readouterr().out
    monkeypatch.setattr("envtf_lit.cli.project.find_spec", lambda name: None)
    main(["init", str(tmp_path / "without")])
    assert "Next: pip install 'envtf-lit[pipeline]' && cd" in capsys.readouterr().out


WITHOUT_EXTRAS = """
import sys
names = "dvc dvclive IPython ipykernel jinja2 jupyter_client nbconvert nbformat onnx onnxruntime onnxscript papermill "
names += "pyarrow ray sbx tensorboard"
for name in names.split():
    sys.modules[name] = None
import envtf_lit.pipeline.evaluate, envtf_lit.pipeline.train_policy, envtf_lit.cli.lightning
import envtf_lit.zoo.build, envtf_lit.studies.horizon, envtf_lit.comparison.runner
print(envtf_lit.load_dataset, envtf_lit.load_policy, envtf_lit.load_world_model)
"""


def test_the_library_needs_no_extra() -> None:
    result = subprocess.run([sys.executable, "-c", WITHOUT_EXTRAS], capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr


class TornMujoco:
    """mujoco-core after pip removed the files of MuJoCo 3, which had the same names."""

    version = "4.0.0"

    def __init__(self, folder: Path, *names: str) -> None:
        self.files = [Recorded(folder / name) for name in names]


class Recorded:
    def __init__(self, path: Path) -> None:
        self.path, self.suffix = path, path.suffix

    def locate(self) -> Path:
        return self.path


def test_doctor_finds_a_mujoco_torn_by_its_upgrade(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "__init__.py").touch()
    torn = TornMujoco(tmp_path, "__init__.py", "_specs.so", "__init__.cpython-311.pyc")
    monkeypatch.setattr("envtf_lit.project.doctor.distribution", lambda name: torn)
    monkeypatch.setattr("envtf_lit.project.doctor._rendering", lambda: "not asked")
    said = doctor_report()["mujoco"]
    assert said.startswith("4.0.0, broken: 1 files of mujoco-core are missing")
    cure = "pip install --force-reinstall --no-deps mujoco==4.0.0 mujoco-core==4.0.0 mujoco-studio==4.0.0"
    assert said.endswith(cure)
    (tmp_path / "_specs.so").touch()
    assert doctor_report()["mujoco"] == version("mujoco")


# the package's own face


def test_the_package_tells_its_version_and_its_names() -> None:
    assert envtf_lit.__version__ == version("envtf-lit")
    assert set(envtf_lit.__all__) <= set(dir(envtf_lit))
    assert all(getattr(envtf_lit, name) for name in envtf_lit.__all__)
    with pytest.raises(AttributeError, match="load_models"):
        envtf_lit.load_models  # noqa: B018  # pyright: ignore[reportAttributeAccessIssue]
    assert (ROOT / "envtf_lit/py.typed").is_file()
