"""Jobs on a Ray cluster: Ray schedules them, waits for those that others need, and ends them with us."""

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from envtf_lit.comparison.jobs import Done, Job, Outcome, attempt, failed
from envtf_lit.errors import UserError, missing_extra

if TYPE_CHECKING:
    from ray import ObjectRef

LOCAL = "local"  # the address of a cluster that is started here, and ends with us


def run_on_ray(jobs: Sequence[Job], address: str, workers: int) -> Done:
    """Does jobs as tasks of a Ray cluster, and yields each as it is done; as `jobs.run_jobs` otherwise.

    Each task takes a core, has a process of its own, and takes a GPU where the cluster has any. All nodes must see the
    folders that the jobs name, under the same paths, and have this package.

    Args:
        jobs: those that others wait for come before them.
        address: of the cluster, such as `auto` or `10.0.0.1:6379`; `local` starts one on this machine.
        workers: cores of a cluster that is started here.

    Raises:
        UserError: Ray is not installed, or there is no cluster at that address.
    """
    with _cluster(address, workers):
        import ray

        gpus = 1 if ray.cluster_resources().get("GPU") else 0
        remote = ray.remote(num_cpus=1, num_gpus=gpus, max_calls=1, max_retries=0)(_attempt)
        submitted: dict[str, ObjectRef] = {}
        waiting: dict[ObjectRef, Job] = {}
        for job in jobs:
            needed = [submitted[name] for name in job.after]
            submitted[job.name] = remote.remote(job, *needed)
            waiting[submitted[job.name]] = job
        while waiting:
            (reference,), _ = ray.wait(list(waiting))
            yield waiting.pop(reference), _outcome(reference)


def _attempt(job: Job, *before: Outcome) -> Outcome:
    """The task; what it waits for are its arguments, so that Ray starts it when they are there."""
    cause = next((name for name, outcome in zip(job.after, before, strict=True) if outcome.error is not None), None)
    return attempt(job) if cause is None else failed(job, cause)


def _outcome(reference: "ObjectRef") -> Outcome:
    import ray
    from ray.exceptions import RayError

    try:
        return ray.get(reference)
    except RayError as error:  # the process died, or a node, or one that this waited for
        return Outcome(error=f"Ray lost it: {str(error).strip().splitlines()[0]}")


@contextmanager
def _cluster(address: str, workers: int) -> Iterator[None]:
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # or it reports to its makers
    os.environ.setdefault("RAY_agent_register_timeout_ms", "120000")  # a busy machine needs more than its 15 s to start
    try:
        import ray
    except ImportError as error:
        raise missing_extra("--ray-address needs Ray", "cluster", error) from None
    given: dict[str, Any] = {"num_cpus": workers, "include_dashboard": False} if address == LOCAL else {}
    try:
        ray.init(address=address, log_to_driver=False, configure_logging=False, **given)
    except Exception as error:  # Ray raises that itself where a node is slow to start
        ray.shutdown()
        reason = (str(error).strip() or type(error).__name__).splitlines()[0].rstrip(".")
        cure = "try again on a machine that is less busy" if address == LOCAL else "start one with `ray start --head`"
        raise UserError(f"There is no Ray cluster at {address!r} ({reason}): {cure}.") from None
    try:
        yield
    finally:
        ray.shutdown()
