"""Trained models that travel: to a folder, such as a mounted remote, or to the Hugging Face hub, and back.

What comes back is safetensors and JSON under names that are known, no larger than such files are; it is loaded before
it takes its place, so that a folder which is there is a model that works.
"""

import contextlib
import hashlib
import json
import os
import re
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import requests
from torch import nn

from envtf_lit.actors import POLICIES, Actor
from envtf_lit.critics import CRITICS, load_critics
from envtf_lit.errors import UserError, did_you_mean
from envtf_lit.files import read_json, replacing, write_text
from envtf_lit.policy import load_policy
from envtf_lit.world_models.ensemble import EnsembleDynamics
from envtf_lit.world_models.store import WORLD_MODELS, load_world_model
from envtf_lit.world_models.termination_head import TERMINATION, load_termination
from envtf_lit.world_models.transformer import EnvironmentTransformer

HUB = "hf:"  # before user/name
CARD = "README.md"
JSON_BYTES, WEIGHTS_BYTES = 4 << 20, 4 << 30
NEEDED = {"config.json": JSON_BYTES, "weights.safetensors": WEIGHTS_BYTES}
# all that is taken over from elsewhere, and the most bytes of each
ALLOWED = NEEDED | {
    "metrics.json": JSON_BYTES,
    "resolved.json": JSON_BYTES,
    **{f"{part}/{name}": most for part in (CRITICS, TERMINATION) for name, most in NEEDED.items()},
}
REPOSITORY = re.compile(r"[A-Za-z0-9][\w.-]{0,95}/[A-Za-z0-9][\w.-]{0,95}")
TIMEOUT = (10, 60)  # seconds: to connect, between two pieces
PIECE = 1 << 20

Model = Actor | EnvironmentTransformer | EnsembleDynamics


def load_model(folder: str | Path) -> Model:
    """The policy or world model in a folder, whichever it is.

    Raises:
        UserError: the folder is missing, damaged, or holds neither.
    """
    config = read_json(Path(folder) / "config.json")
    kind = str(config.get("kind")) if isinstance(config, dict) else ""
    if kind in POLICIES:
        return load_policy(folder)
    if kind in WORLD_MODELS:
        return load_world_model(folder)
    known = did_you_mean(kind, [*POLICIES, *WORLD_MODELS])
    raise UserError(f"{folder}/config.json names the unknown kind {kind!r}: {known}")


def push(folder: str | Path, target: str, card: Callable[[Path], str], *, private: bool = False) -> None:
    """Sends a model, with its card, to a new folder or to the hub.

    Args:
        folder: of a policy or a world model.
        target: a folder that is not there yet; or `hf:user/name`, whose files are replaced by one commit.
        card: writes the text of the model's card, where the folder has none.
        private: of a repository on the hub that is made for it.

    Raises:
        UserError: the folder holds no model, the target is there already or is no name, or the hub refuses. Nothing
            half-written stays in a folder, and no commit on the hub.
    """
    folder = Path(folder)
    _check(folder)
    text = (folder / CARD).read_text(errors="replace") if (folder / CARD).is_file() else card(folder)
    if target.startswith(HUB):
        _to_hub(folder, _repository(target), text, private)
        return
    _free(Path(target))
    with replacing(target) as temporary:
        _copy(folder, temporary)
        write_text(temporary / CARD, text)


def pull(source: str, folder: str | Path) -> Model:
    """Fetches a model into a new folder.

    Args:
        source: a folder, or `hf:user/name`; the hub is that of `HF_ENDPOINT`.
        folder: a place that is free.

    Returns:
        The model, which has been loaded from what was fetched.

    Raises:
        UserError: there is no such model, it lacks a file, a file is too large or damaged, the hub refuses or breaks
            off, or something stands in the place. Nothing half-written stays.
    """
    _free(Path(folder))
    with replacing(folder) as temporary:
        if source.startswith(HUB):
            _from_hub(_repository(source), temporary)
        else:
            _copy(Path(source), temporary)
        try:
            return _check(temporary)
        except UserError as error:
            raise UserError(str(error).replace(str(temporary), source)) from None


def _check(folder: Path) -> Model:
    """Loads all that is in the folder."""
    model: nn.Module = load_model(folder)
    for name in ("metrics.json", "resolved.json"):
        if (folder / name).exists():
            read_json(folder / name)
    if (folder / TERMINATION).is_dir():
        load_termination(folder / TERMINATION)
    if (folder / CRITICS).is_dir():
        load_critics(folder)
    return model


def _free(place: Path) -> None:
    if os.path.lexists(place):
        raise UserError(f"{place} exists already: name a new folder, or move this one.")


def _copy(source: Path, target: Path) -> None:
    if not source.is_dir():
        raise UserError(f"{source} is not a model folder: it does not exist; check the path.")
    target.mkdir()
    for name, most in ALLOWED.items():
        path = source / name
        if path.is_file():
            _check_size(str(path), path.stat().st_size, most)
            (target / name).parent.mkdir(exist_ok=True)
            shutil.copyfile(path, target / name)
        elif name in NEEDED:
            raise UserError(f"{source} has no {name}: give the folder of a trained model.")


def _check_size(name: str, size: int, most: int) -> None:
    if size > most:
        raise UserError(f"{name} has {size:,} bytes, and such a file has at most {most:,}: it is no model of ours.")


# the hub


def _repository(name: str) -> str:
    repository = name.removeprefix(HUB)
    if not REPOSITORY.fullmatch(repository) or ".." in repository:
        raise UserError(f"{name!r} names no model on the hub: write hf:user/name.")
    return repository


def _endpoint() -> str:
    return os.environ.get("HF_ENDPOINT", "https://huggingface.co").rstrip("/")


def _to_hub(folder: Path, repository: str, card: str, private: bool) -> None:
    from huggingface_hub import CommitOperationAdd, HfApi

    present = [name for name in ALLOWED if (folder / name).is_file()]
    files = [CommitOperationAdd(path_in_repo=name, path_or_fileobj=folder / name) for name in present]
    files.append(CommitOperationAdd(path_in_repo=CARD, path_or_fileobj=card.encode()))
    hub = HfApi(endpoint=_endpoint())
    try:
        with _silent():
            hub.create_repo(repository, private=private, exist_ok=True)
            hub.create_commit(repository, files, commit_message=f"Upload {folder.name}")
    except Exception as error:  # of its own, of the HTTP client beneath, of the system
        answer = getattr(error, "response", None)
        raise _refusal(repository, getattr(answer, "status_code", None), error) from None


def _from_hub(repository: str, target: Path) -> None:
    target.mkdir()
    address = f"{_endpoint()}/api/models/{repository}?blobs=true"
    facts = _json(repository, address)
    listed = facts.get("siblings") if isinstance(facts, dict) else None
    rows = [row for row in listed if isinstance(row, dict)] if isinstance(listed, list) else []
    there = {row["rfilename"]: row for row in rows if isinstance(row.get("rfilename"), str)}
    lacking = next((name for name in NEEDED if name not in there), None)
    if lacking is not None:
        raise UserError(f"hf:{repository} has no {lacking}: it is no model that `envtf push` wrote.")
    commit = facts.get("sha")
    revision = commit if isinstance(commit, str) and re.fullmatch("[0-9a-f]{40}", commit) else "main"
    for name in (name for name in ALLOWED if name in there):
        (target / name).parent.mkdir(exist_ok=True)
        _download(repository, f"{_endpoint()}/{repository}/resolve/{revision}/{name}", target / name, name, there[name])


@contextlib.contextmanager
def _get(repository: str, address: str) -> Iterator[requests.Response]:
    """The body of an answer, which may break off inside the block; a token goes to the hub and to nobody else."""
    from huggingface_hub import get_token

    token = get_token()
    headers = {"Accept-Encoding": "identity"} | ({"Authorization": f"Bearer {token}"} if token else {})
    try:
        with requests.get(address, headers=headers, stream=True, timeout=TIMEOUT) as response:
            if response.status_code != 200:
                raise _refusal(repository, response.status_code, None)
            yield response
    except requests.RequestException as error:
        raise _refusal(repository, None, error) from None


def _pieces(response: requests.Response, name: str, most: int) -> Iterator[bytes]:
    """The body, up to so many bytes, whatever was announced."""
    size = 0
    for piece in response.iter_content(PIECE):
        size += len(piece)
        _check_size(name, size, most)
        yield piece


def _json(repository: str, address: str) -> Any:
    with _get(repository, address) as response:
        content = b"".join(_pieces(response, f"The list of hf:{repository}'s files", JSON_BYTES))
    try:
        return json.loads(content)
    except (ValueError, RecursionError):
        raise UserError(f"{_endpoint()} does not answer as a hub does, with JSON: check HF_ENDPOINT.") from None


def _download(repository: str, address: str, path: Path, name: str, facts: dict[str, Any]) -> None:
    """One file, of the size and sum that the hub has stated."""
    size, digest = 0, hashlib.sha256()
    with _get(repository, address) as response, path.open("wb") as stream:
        for piece in _pieces(response, f"{name} of hf:{repository}", ALLOWED[name]):
            size += len(piece)
            digest.update(piece)
            stream.write(piece)
    stated, large = facts.get("size"), facts.get("lfs")
    known = large.get("sha256") if isinstance(large, dict) else None
    if (isinstance(stated, int) and stated != size) or (known is not None and known != digest.hexdigest()):
        raise UserError(f"{name} of hf:{repository} came damaged ({size:,} bytes of {stated}): pull again.")


def _refusal(repository: str, status: int | None, error: Exception | None) -> UserError:
    where = f"hf:{repository} at {_endpoint()}"
    if status in (401, 403):
        text = f"{where} asks for a token that may do this ({status}): `hf auth login`, or set HF_TOKEN."
    elif status == 404:
        text = f"{where} does not exist (404): check the name, or log in if it is private."
    elif status is not None:
        text = f"{where} cannot be reached, the hub answers {status}: try again later."
    else:
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        text = f"{where} cannot be reached, or broke off ({reason}): try again."
    return UserError(text)


@contextlib.contextmanager
def _silent() -> Iterator[None]:
    """Without the library's bars."""
    from huggingface_hub.utils import are_progress_bars_disabled, disable_progress_bars, enable_progress_bars

    before = are_progress_bars_disabled()
    disable_progress_bars()
    try:
        yield
    finally:
        if not before:
            enable_progress_bars()
