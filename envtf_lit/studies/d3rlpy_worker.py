"""d3rlpy's side of a comparison: a process in an environment of its own, which has d3rlpy and not this package.

`PYTHON d3rlpy_worker.py LOG.npz THREADS` reads one JSON line a job from its standard input and answers each by one,
after a first line with d3rlpy's version. A job is `{"name": …, "seed": …, "updates": …}`: so many updates of the
algorithm of that name and seed, by d3rlpy's own `fit`, on the rows of the log; with `"save": FILE.npz` its actor lies
there afterwards: weights and biases of the layers whose tanh is the action. The answer is `{"seconds": …}`.
"""

import json
import sys
import time
from collections.abc import Callable
from importlib import import_module
from typing import Any

import numpy as np

HIDDEN, BATCH = [256, 256, 256], 256


def configs(d3rlpy: Any) -> dict[str, Callable[[], Any]]:
    """The algorithms at our settings (`agent_speed.OPTIONS`), by our names."""
    net = d3rlpy.models.encoders.VectorEncoderFactory(hidden_units=HIDDEN, activation="relu")
    nets = dict(actor_encoder_factory=net, critic_encoder_factory=net, batch_size=BATCH, gamma=0.99, tau=0.005)
    algos = d3rlpy.algos
    return {
        "cql": lambda: algos.CQLConfig(
            **nets,
            actor_learning_rate=3e-4,
            temp_learning_rate=3e-4,
            alpha_learning_rate=0.0,  # the weight stays as it is
            initial_temperature=0.01,
            alpha_threshold=0.0,
            conservative_weight=5.0,
            n_action_samples=10,
        ),
        "iql": lambda: algos.IQLConfig(**nets, value_encoder_factory=net),
        "td3_bc": lambda: algos.TD3PlusBCConfig(**nets),
        "rebrac": lambda: algos.ReBRACConfig(
            **nets, actor_learning_rate=3e-4, critic_learning_rate=3e-4, actor_beta=0.01, critic_beta=0.01
        ),
    }


def now(threads: int) -> float:
    """Seconds of this process where it has one thread, which other work on the machine does not stretch; else of a
    clock."""
    return time.process_time() if threads == 1 else time.perf_counter()


class Worker:
    """Algorithms that learn from one log, each as far as it was asked to."""

    def __init__(self, path: str, threads: int) -> None:
        self.d3rlpy: Any = import_module("d3rlpy")
        self.torch: Any = import_module("torch")
        self.torch.set_num_threads(threads)
        self.threads = threads
        log = np.load(path, allow_pickle=False)
        self.data = self.d3rlpy.dataset.MDPDataset(
            observations=log["observations"],
            actions=log["actions"],
            rewards=log["rewards"],
            terminals=log["terminals"],
            timeouts=log["timeouts"],
        )
        self.begun = dict[tuple[str, int], Any]()

    def run(self, job: dict[str, Any]) -> dict[str, float]:
        """Seconds of the job's updates; making networks is not counted."""
        key = job["name"], job["seed"]
        if key not in self.begun:
            self.d3rlpy.seed(job["seed"])
            algorithm = configs(self.d3rlpy)[job["name"]]().create(device="cpu:0")
            algorithm.build_with_dataset(self.data)
            self.begun[key] = algorithm
        begin = now(self.threads)
        self.begun[key].fit(
            self.data,
            n_steps=job["updates"],
            n_steps_per_epoch=job["updates"],
            show_progress=False,
            save_interval=sys.maxsize,
            logger_adapter=self.d3rlpy.logging.NoopAdapterFactory(),
        )
        seconds = now(self.threads) - begin
        if "save" in job:
            policy = self.begun[key].impl.policy.state_dict()
            layers = [value.numpy() for name, value in policy.items() if "logstd" not in name]
            np.savez(job["save"], *layers)
        return {"seconds": seconds}


def main() -> None:
    """Answers until there are no more jobs; d3rlpy's own log goes to the standard error."""
    answers, sys.stdout = sys.stdout, sys.stderr
    worker = Worker(sys.argv[1], int(sys.argv[2]))
    answers.write(json.dumps({"d3rlpy": worker.d3rlpy.__version__, "torch": worker.torch.__version__}) + "\n")
    answers.flush()
    for line in sys.stdin:
        answers.write(json.dumps(worker.run(json.loads(line))) + "\n")
        answers.flush()


if __name__ == "__main__":
    main()
