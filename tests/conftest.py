"""One thread per test process: the suite runs side by side with xdist, and busy threads that outnumber cores crawl."""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("MKL_NUM_THREADS", "1")

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from envtf_lit.pipeline.yaml import params_yaml, preset_params
from envtf_lit.world_models.options import EnsembleOptions, WorldModelOptions

torch.set_num_threads(1)


@pytest.fixture(scope="session", autouse=True)
def short_promises() -> Iterator[None]:
    """What a world model promises of a policy is asked of imagined episodes of at most 30 steps, not of 1,000."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("envtf_lit.imagination.promise.LONGEST", 30)
        yield


@pytest.fixture(scope="session")
def repository() -> Path:
    """The root of the checkout."""
    return Path(__file__).parent.parent


@pytest.fixture
def project(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty folder with the tiny preset's params.yaml, and the current one."""
    (tmp_path / "params.yaml").write_text(params_yaml(preset_params("tiny")))
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def small_models(monkeypatch: pytest.MonkeyPatch) -> None:
    """Transformers of the studies have one small layer; a study takes its time all the same."""
    from envtf_lit.studies import ablation, suite  # takes seconds, in which most single files are tested

    full_size = suite.model_options

    def small(name: str, options: suite.SuiteOptions) -> WorldModelOptions:
        found = full_size(name, options)
        if isinstance(found, EnsembleOptions):
            return found
        return replace(found, layers=1, heads=2, width=16, random_features=8)

    for module in (suite, ablation):
        monkeypatch.setattr(module, "model_options", small)


@pytest.fixture
def minari_root(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of a test's Minari datasets."""
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    return tmp_path / "minari"
