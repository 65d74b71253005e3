"""More processes than one: the same training as one process with all their rows."""

import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from lightning.pytorch.strategies import FSDPStrategy
from ruamel.yaml import YAML
from safetensors.torch import load_file

from envtf_lit.cli.main import main
from envtf_lit.data.sources.files import save_dataset
from tests.walker import walker_dataset

MODEL = ["layers=1", "heads=2", "width=16", "context=4", "updates_per_epoch=3", "updates=6"]
AGENT = ["hidden=[8]", "warm_start=0.25", "updates_per_epoch=20", "updates=40"]


def fit(folder: Path, kind: str, *flags: str) -> tuple[pd.DataFrame, dict]:
    """Trains in processes of their own; the logged curves and the published weights."""
    options = [f"--model.options.{option}" for option in (MODEL if kind == "model" else AGENT)]
    shown = [f"--trainer.{name}=false" for name in ("enable_progress_bar", "enable_model_summary")]
    logger = ["--trainer.logger=CSVLogger", f"--trainer.logger.save_dir={folder}", "--trainer.accelerator=cpu"]
    data = f"--data.path={folder.parent}/data.h5"
    command = [sys.executable, "-m", "envtf_lit", kind, "fit", *flags, data, *options, *shown, *logger]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("Published the weights") == 1
    (run,) = folder.glob("lightning_logs/version_*")
    return pd.read_csv(run / "metrics.csv"), load_file(run / "published/weights.safetensors")


# Lightning 2.6's use of an older jsonargparse's names
pytestmark = pytest.mark.filterwarnings("ignore::jsonargparse._deprecated.JsonargparseDeprecationWarning")


@pytest.mark.slow
def test_two_processes_train_as_one_with_the_doubled_batch(tmp_path: Path) -> None:
    save_dataset(walker_dataset(), tmp_path / "data.h5")  # short episodes: windows of different length in each half
    two, weights = fit(tmp_path / "two", "model", "--config=ddp", "--trainer.devices=2", "--model.options.batch_size=4")
    one, expected = fit(tmp_path / "one", "model", "--trainer.devices=1", "--model.options.batch_size=8")
    assert list(two.columns) == list(one.columns)
    for name in ("train/loss", "val/loss", "val/open_loop_error"):
        np.testing.assert_allclose(two[name].dropna(), one[name].dropna(), rtol=1e-4)
    for name, value in expected.items():
        if name.startswith(("blocks", "head", "embed")):
            np.testing.assert_allclose(weights[name], value, rtol=1e-3, atol=1e-5, err_msg=name)


@pytest.mark.slow
def test_agents_train_in_two_processes(tmp_path: Path) -> None:
    save_dataset(walker_dataset(), tmp_path / "data.h5")
    strategy = ["--config=ddp", "--trainer.devices=2", "--trainer.strategy=ddp_find_unused_parameters_true"]
    curves, _ = fit(tmp_path / "two", "agent", *strategy, "--model.options.batch_size=4")
    assert np.isfinite(curves["val/q_data"].dropna()).all()


@pytest.mark.parametrize("name", ["ddp", "fsdp", "finetune"])
def test_shipped_configurations_are_understood(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["model", "fit", "--config", name, "--data.path=data.h5", "--print_config"])
    assert stop.value.code == 0
    trainer = YAML(typ="safe", pure=True).load(capsys.readouterr().out)["trainer"]
    if name == "ddp":
        assert trainer["strategy"] == "ddp"
    elif name == "fsdp":
        assert trainer["strategy"]["class_path"] == "lightning.pytorch.strategies.FSDPStrategy"
        names = ("sharding_strategy", "cpu_offload", "state_dict_type")
        given: dict[str, Any] = {name: trainer["strategy"]["init_args"][name] for name in names}
        assert FSDPStrategy(**given).cpu_offload.offload_params
    else:
        assert [callback["class_path"].rpartition(".")[2] for callback in trainer["callbacks"]] == [
            "EarlyStopping",
            "ModelCheckpoint",
        ]
