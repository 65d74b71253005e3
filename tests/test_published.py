"""Published settings: every row of every file builds its algorithm's options, and params.yaml is made of it."""

from pathlib import Path

import pytest
from ruamel.yaml import YAML

from envtf_lit.agents.registry import ALGORITHMS
from envtf_lit.cli.main import main
from envtf_lit.errors import UserError
from envtf_lit.pipeline.params import COMMON, build_params
from envtf_lit.pipeline.published import ORIGINS, published_options, published_params, published_rows
from envtf_lit.pipeline.yaml import params_yaml
from envtf_lit.robots.tasks import ROBOTS, get_task

FILES = Path(__file__).parent.parent / "envtf_lit/configs/algorithms"
TASKS = [f"{robot}-{tier}" for robot in ROBOTS for tier in ("random", "medium", "medium-replay", "medium-expert")]


def test_each_algorithm_has_a_file_and_each_file_an_algorithm() -> None:
    assert {path.stem for path in FILES.iterdir()} == set(ALGORITHMS)


@pytest.mark.parametrize("algorithm", list(ALGORITHMS))
def test_every_row_builds_the_algorithms_options(algorithm: str) -> None:
    rows = published_rows(algorithm)
    assert set(TASKS) <= rows.keys()
    for task, row in rows.items():
        get_task(task)
        options = published_options(algorithm, task)
        assert type(options) is ALGORITHMS[algorithm].Options
        assert row["origin"] in ORIGINS
        for name, value in row.items():
            if isinstance(value, int | float) and not isinstance(value, bool):
                assert getattr(options, name) == value


@pytest.mark.parametrize("algorithm", list(ALGORITHMS))
def test_a_file_says_at_its_head_whose_each_row_is(algorithm: str) -> None:
    text = (FILES / f"{algorithm}.yaml").read_text()
    head = text[: text.index("common:")]
    assert head.startswith("# ")
    origins = {row["origin"] for row in published_rows(algorithm).values()}
    words = {
        "ours": ("`ours`", "all rows are ours", "Our own"),
        "paper": ("`paper`", "The Environment Transformer's paper"),
    }
    assert all(any(word in head for word in words.get(origin, (f"`{origin}`",))) for origin in origins)


@pytest.mark.parametrize(
    ("algorithm", "task", "known"),
    [
        ("mopo", "hopper-medium", {"horizon": 5, "penalty": 5.0}),
        ("mopo", "walker2d-medium-replay", {"horizon": 1, "penalty": 2.5}),
        ("rambo", "hopper-medium-replay", {"horizon": 2, "adversarial_weight": 0.0003}),
        ("rambo", "walker2d-medium", {"horizon": 5, "adversarial_weight": 0.0}),
        ("mobile", "halfcheetah-medium-expert", {"bellman_penalty": 1.0, "real_ratio": 0.5}),
        ("combo", "walker2d-medium-expert", {"horizon": 1, "cql_weight": 5.0}),
        ("rebrac", "hopper-medium-replay", {"actor_penalty": 0.05, "critic_penalty": 0.5, "batch_size": 1024}),
        ("iql", "hopper-medium", {"expectile": 0.7, "beta": 3.0, "return_range": 1000.0}),
        ("td3_bc", "ant-medium", {"alpha": 2.5, "policy_delay": 2, "target_noise": 0.2, "noise_clip": 0.5}),
    ],
)
def test_rows_hold_what_was_published(algorithm: str, task: str, known: dict[str, float]) -> None:
    options = published_options(algorithm, task)
    for name, value in known.items():
        holder = options if hasattr(options, name) else options.rollouts  # pyright: ignore[reportAttributeAccessIssue]
        assert getattr(holder, name) == value


@pytest.mark.parametrize("preset", ["tiny", "small"])
@pytest.mark.parametrize("algorithm", list(ALGORITHMS))
def test_params_yaml_is_made_of_a_row(algorithm: str, preset: str) -> None:
    params = published_params(algorithm, "walker2d-medium", preset)
    assert params.task == "walker2d-medium"
    assert params.train_policy[algorithm] == published_options(algorithm, "walker2d-medium")
    assert set(params.train_policy) == {"bc", algorithm}
    assert build_params(YAML(typ="safe", pure=True).load(params_yaml(params))) == params
    if ALGORITHMS[algorithm].imagines:
        assert {*params.train_model} == {params.train_policy[algorithm].world_model} == {params.evaluate.world_model}


def test_published_settings_are_the_policys_own_and_leave_alone_what_all_share() -> None:
    plain, params = build_params({}), published_params("iql", "hopper-medium")
    assert params.policy == plain.policy
    assert {name for name in COMMON if getattr(params.train_policy["iql"], name) != getattr(plain.policy, name)} >= {
        "updates",
        "discount",
        "n_step",
    }


def test_the_command_prints_them(capsys: pytest.CaptureFixture[str]) -> None:
    main(["params", "--algorithm", "mopo", "--task", "hopper-medium"])
    assert capsys.readouterr().out == params_yaml(published_params("mopo", "hopper-medium"))
    with pytest.raises(SystemExit):
        main(["params", "--task", "hopper-medium"])
    assert "say of which --algorithm, too" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("algorithm", "task", "message"),
    [
        ("mop", "hopper-medium", "Unknown algorithm 'mop': did you mean 'mopo'"),
        ("mopo", "hopper-medum", "no settings of mopo for 'hopper-medum': did you mean 'hopper-medium'"),
    ],
)
def test_an_unknown_row_is_refused_with_the_nearest_one(algorithm: str, task: str, message: str) -> None:
    with pytest.raises(UserError, match=message):
        published_params(algorithm, task)
