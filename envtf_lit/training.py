"""One way to train a LightningModule: resumable, quiet or with a progress bar, and leaving nothing half-written."""

import contextlib
import ctypes
import hashlib
import io
import json
import logging
import platform
import shutil
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Literal

import lightning as L
import torch
from lightning.pytorch.callbacks import Callback, Checkpoint, ModelCheckpoint, RichProgressBar
from lightning.pytorch.plugins.io import TorchCheckpointIO
from torch import nn

from envtf_lit.devices import multiplies_bf16, pick_device, resolved
from envtf_lit.divergence import check_epoch
from envtf_lit.errors import UserError, did_you_mean
from envtf_lit.files import check_writable, replacing, write_json, write_table
from envtf_lit.options.schema import Precision
from envtf_lit.progress import note

logging.getLogger("lightning.pytorch").setLevel(logging.WARNING)  # says what hardware there is at every fit
RUNS = Path(".envtf/runs")
LIGHTNING: dict[str, Literal["bf16-mixed", "32-true"]] = {"bf16": "bf16-mixed", "fp32": "32-true"}  # its words
# glibc's M_MMAP_THRESHOLD (the largest there is) and M_TRIM_THRESHOLD, in bytes: what is below them is kept
MALLOC = {-3: 32 << 20, -1: 512 << 20}


def run_folder(root: Path, stage: str, parameters: Any, inputs: Sequence[Path]) -> Path:
    """Where a run's resumable checkpoints live: named by its parameters and its inputs' bytes.

    A run that was killed finds its own checkpoint again; one with other parameters or data starts afresh.
    """
    digest = hashlib.blake2b(json.dumps(parameters, sort_keys=True, default=str).encode(), digest_size=8)
    for path in inputs:
        files = sorted(p for p in path.rglob("*") if p.is_file()) if path.is_dir() else [path]
        for file in files:
            with file.open("rb") as stream:
                digest.update(hashlib.file_digest(stream, "blake2b").digest())
    return root / RUNS / f"{stage}-{digest.hexdigest()}"


class Curves(Checkpoint):
    """Keeps one row of logged metrics per epoch, in the checkpoint too, so that a resumed run's curves are whole.

    A `Checkpoint` by type alone: Lightning calls those after the module, whose own epoch-end metrics belong in the row.
    """

    def __init__(self) -> None:
        self.rows: list[dict[str, float]] = []

    def on_train_batch_start(
        self, trainer: L.Trainer, pl_module: L.LightningModule, batch: object, batch_index: int
    ) -> None:
        if batch_index == 0:  # or what this epoch does not log would be repeated from the one before
            trainer.callback_metrics.clear()

    def on_train_epoch_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        values = {name: float(value) for name, value in sorted(trainer.callback_metrics.items())}
        self.rows.append({"epoch": trainer.current_epoch + 1, **values})

    def state_dict(self) -> dict[str, Any]:
        return {"rows": self.rows}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.rows = state_dict["rows"]

    def write(self, path: Path) -> None:
        """Writes the rows as CSV; a metric that an epoch did not log is left empty."""
        write_table(path, self.rows)


class Guard(Checkpoint):
    """Stops a training at the end of an epoch that diverged; see `check_epoch`.

    A `Checkpoint` by type alone, to be called after the module, and in front of those that write: nothing of that epoch
    is kept. A module may have a `label`, and `cures` and `bounds` of its own.
    """

    def on_train_epoch_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        label = getattr(pl_module, "label", type(pl_module).__name__)
        own = {name: getattr(pl_module, name) for name in ("cures", "bounds") if hasattr(pl_module, name)}
        check_epoch(trainer.callback_metrics, pl_module, label, trainer.current_epoch + 1, **own)


class WholeCheckpoints(TorchCheckpointIO):
    """Leaves the old checkpoint or the new one, whatever happens meanwhile: Lightning's own way may copy in place."""

    def save_checkpoint(self, checkpoint: dict[str, Any], path: str | Path, storage_options: Any = None) -> None:
        """As Lightning's, through a temporary file beside `path` that is on the disk before it takes its place.

        Raises:
            UserError: the disk is full, or the place cannot be written.
        """
        if "://" in str(path):  # no file of ours
            super().save_checkpoint(checkpoint, path, storage_options)
            return
        buffer = io.BytesIO()
        torch.save(checkpoint, buffer)  # so that a full disk is an OSError
        with replacing(path) as temporary:
            temporary.write_bytes(buffer.getbuffer())


@contextlib.contextmanager
def trained(
    module: L.LightningModule,
    data: L.LightningDataModule,
    *,
    run: Path,
    target: Path | None,
    epochs: int,
    precision: Precision,
    progress: bool = True,
    monitor: str | None = None,
    validate: bool = True,
    mode: Literal["min", "max"] = "min",
    gradient_clip: float | None = None,
    callbacks: Sequence[Callback] = (),
) -> Iterator[Curves]:
    """Trains for `epochs`, resuming from `run` if a checkpoint lies there, and yields the curves to a block that
    publishes; until that has succeeded, `run` stays: after a kill there, nothing is left to train.

    A checkpoint that cannot be read, or that another version wrote, is set aside, and training starts anew.

    Args:
        module: holds its final weights in the block, or with `monitor` those of the epoch where it was best.
        run: folder of the resumable checkpoints, removed at the end.
        target: folder that the block will write; None writes none.
        monitor: logged name to select the kept weights by.
        validate: run the validation loop after each epoch.
        mode: whether the least or the largest value of `monitor` is best.
        gradient_clip: largest gradient norm, for automatic optimisation alone.
        callbacks: further ones; a `Checkpoint` among them is called before an epoch's checkpoint is written, so that
            its state is in there, and not for an epoch that diverged.

    Raises:
        UserError: `target` or `run` cannot be written, before any training; or the training diverged.
    """
    if target is not None:
        check_writable(target, folder=True)
    check_writable(run / "last.ckpt", folder=False)
    checkpoint = _checkpoint(run, ("last",) if monitor is None else ("last", "best"), module)
    curves = Curves()
    keepers = [Guard(), *callbacks, *_keepers(run, curves, monitor, mode)]
    trainer = L.Trainer(
        max_epochs=epochs,
        precision=LIGHTNING[_checked(precision)],
        accelerator="auto",
        devices=1,
        callbacks=[*keepers, *([RichProgressBar()] if progress else [])],
        plugins=[WholeCheckpoints()],
        logger=False,
        enable_progress_bar=progress,
        enable_model_summary=False,
        num_sanity_val_steps=0,
        limit_val_batches=None if validate else 0,
        gradient_clip_val=gradient_clip,
    )
    _fit(trainer, module, data, checkpoint)
    if monitor is not None:
        kept = torch.load(run / "best.ckpt", map_location="cpu", weights_only=True)
        module.load_state_dict(kept["state_dict"])
    yield curves
    shutil.rmtree(run, ignore_errors=True)


def _fit(trainer: L.Trainer, module: L.LightningModule, data: L.LightningDataModule, checkpoint: Path | None) -> None:
    """Fits from a checkpoint, if there is one; an interrupt, of which Lightning makes an end, stays one."""
    with warnings.catch_warnings():
        # Lightning's use of an older torch's name helps nobody, least of all in a notebook
        warnings.filterwarnings("ignore", r"`isinstance\(treespec, LeafSpec\)` is deprecated", FutureWarning)
        trainer.fit(module, datamodule=data, ckpt_path=checkpoint, weights_only=True)
    if trainer.interrupted:
        raise KeyboardInterrupt


def _keepers(run: Path, curves: Curves, monitor: str | None, mode: Literal["min", "max"]) -> list[Callback]:
    """What writes `best.ckpt`, if there is something to monitor, and `last.ckpt`, which must hold the others' state."""
    last = ModelCheckpoint(dirpath=run, filename="last", enable_version_counter=False)
    if monitor is None:
        return [curves, last]
    best = ModelCheckpoint(dirpath=run, filename="best", monitor=monitor, mode=mode, enable_version_counter=False)
    return [best, curves, last]


def _checkpoint(run: Path, names: Sequence[str], module: nn.Module) -> Path | None:
    """The run's last checkpoint, where those of all these names fit the module; else all are set aside."""
    for orphan in run.glob(".*.partial"):  # of a process that was killed as it wrote
        orphan.unlink()
    paths = [run / f"{name}.ckpt" for name in names]
    if not (run / "last.ckpt").exists():
        return None
    faults = ((path, _fault(path, module)) for path in paths)
    found = next(((path, fault) for path, fault in faults if fault), None)
    if found is None:
        return run / "last.ckpt"
    for path in paths:  # together, since one without the other would lead a later run astray
        if path.exists():
            path.replace(path.with_name(f"{path.name}.unreadable"))
    note(f"{found[0]} {found[1]}: it is set aside, and training starts anew.")
    return None


def _fault(checkpoint: Path, module: nn.Module) -> str | None:
    """What is wrong with a checkpoint for this module, if anything."""
    damaged = "is damaged or missing, as after a power cut"
    if not checkpoint.is_file():  # or a pipe, which would never end
        return damaged
    try:
        saved = torch.load(checkpoint, map_location="cpu", weights_only=True)["state_dict"]
        shapes = {name: value.shape for name, value in saved.items()}
    except (OSError, MemoryError):  # says nothing about the file
        raise
    except Exception:  # whatever unpickling raises
        return damaged
    if shapes != {name: value.shape for name, value in module.state_dict().items()}:
        return "holds other weights than this version trains, as after an upgrade"
    return None


def freeze(module: nn.Module, parts: Sequence[str]) -> None:
    """Keeps the parameters of these parts of a module as they are.

    Args:
        module: all others of its parameters stay trainable.
        parts: names of submodules or parameters, such as `blocks`, `blocks.0` or `head.bias`.

    Raises:
        UserError: it has no such part with parameters, or nothing is left to train.
    """
    modules = [name for name, inner in module.named_modules() if name and any(True for _ in inner.parameters())]
    for part in parts:
        if part not in modules and part not in dict(module.named_parameters()):
            large = [name for name in modules if name.count(".") < 2]
            raise UserError(f"There is no part {part!r} to freeze: {did_you_mean(part, large)}")
    for name, parameter in module.named_parameters():
        parameter.requires_grad_(not any(f"{name}.".startswith(f"{part}.") for part in parts))
    if not any(parameter.requires_grad for parameter in module.parameters()):
        raise UserError(f"Freezing {', '.join(parts)} leaves nothing to train: freeze less.")


def _checked(precision: Precision) -> Literal["fp32", "bf16"]:
    """As `resolved`; says so where it will be slow."""
    device = pick_device()
    if precision == "bf16" and not multiplies_bf16(device):
        note(f"This {device.type} is not known to multiply bf16, and may emulate it slowly: take precision: auto.")
    return resolved(precision, device)


def keep_freed_memory() -> None:
    """Lets glibc keep the memory of freed tensors for the next ones.

    Otherwise it goes back to the system, which hands it out again page by page, and zeroed: up to a third of an agent's
    update on a CPU. Does nothing where the allocator is another. Results are the same to the bit.
    """
    if platform.libc_ver()[0] == "glibc":
        library = ctypes.CDLL(None)
        for name, size in MALLOC.items():
            library.mallopt(name, size)


CURVES = "curves.csv"  # below every model


def record_training(folder: Path, metrics: dict[str, Any], settings: dict[str, Any], curves: Any) -> None:
    """Metrics, resolved options and curves beside the weights."""
    write_json(folder / "metrics.json", metrics)
    write_json(folder / "resolved.json", settings)
    curves.write(folder / CURVES)
