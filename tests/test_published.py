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
        ("cql", "hopper-medium", {"cql_weight": 2.5, "hidden": (256, 256, 256), "actor_learning_rate": 0.0001}),
        ("cql", "ant-medium", {"cql_weight": 5.0, "hidden": (256, 256), "actor_learning_rate": 0.0003}),
        ("rebrac", "hopper-medium-replay", {"actor_penalty": 0.05, "critic_penalty": 0.5, "batch_size": 1024}),
        ("iql", "hopper-medium", {"expectile": 0.7, "beta": 3.0, "return_range": 1000.0}),
        ("td3_bc", "ant-medium", {"alpha": 2.5, "policy_delay": 2, "target_noise": 0.2, "noise_clip": 0.5}),
    ],
)
def test_rows_hold_what_was_published(algorithm: str, task: str, known: dict[str, object]) -> None:
    options = published_options(algorithm, task)
    for name, value in known.items():
        holder = options if hasattr(options, name) else options.rollouts  # pyright: ignore[reportAttributeAccessIssue]
        assert getattr(holder, name) == value


ROBOTS_OF = {"hc": "halfcheetah", "ho": "hopper", "wa": "walker2d"}
TIERS_OF = {"R": "random", "M": "medium", "MR": "medium-replay", "ME": "medium-expert"}
# horizon and weight of each published row. MOPO and COMBO: OfflineRL-Kit, and of random MOPO's own; RAMBO and MOBILE:
# their own. COMBO's weight stands before a whole squared error there, ours before half of one.
PUBLISHED = {
    "mopo": "hc-M 5/.5 hc-MR 5/.5 hc-ME 5/2.5 hc-R 5/.5 ho-M 5/5 ho-MR 5/2.5 ho-ME 5/5 ho-R 5/1 wa-M 5/.5 wa-MR 1/2.5 "
    "wa-ME 1/2.5 wa-R 1/1",
    "combo": "hc-M 5/.5 ho-M 5/5 wa-M 1/5 hc-MR 5/.5 ho-MR 5/.5 wa-MR 1/.5 hc-ME 5/5 ho-ME 5/5 wa-ME 1/5",
    "rambo": "hc-M 5/3e-4 hc-ME 5/3e-4 hc-MR 5/3e-4 hc-R 5/0 ho-M 5/3e-4 ho-ME 5/3e-4 ho-MR 2/3e-4 ho-R 2/3e-4 "
    "wa-M 5/0 wa-MR 5/0 wa-R 5/0 wa-ME 2/3e-4",
    "mobile": "hc-R 5/.5 ho-R 5/5 wa-R 5/2 hc-M 5/.5 ho-M 5/1.5 wa-M 5/.5 hc-MR 5/.1 ho-MR 5/.1 wa-MR 1/.5 hc-ME 5/1 "
    "ho-ME 5/1.5 wa-ME 1/1.5",
}


@pytest.mark.parametrize("algorithm", list(PUBLISHED))
def test_every_published_row_of_those_that_imagine_is_here_and_all_others_are_ours(algorithm: str) -> None:
    rows, published = published_rows(algorithm), set[str]()
    for short, values in pairwise_words(PUBLISHED[algorithm]):
        robot, tier = short.split("-")
        published.add(task := f"{ROBOTS_OF[robot]}-{TIERS_OF[tier]}")
        horizon, weight = map(float, values.split("/"))
        row = rows[task]
        held = {"mopo": row["rollouts"].get("penalty"), "combo": 2 * row.get("cql_weight", 0.0)}
        held |= {"rambo": row.get("adversarial_weight"), "mobile": row.get("bellman_penalty")}
        assert (row["rollouts"]["horizon"], held[algorithm]) == (horizon, weight), task
        assert row["origin"] in ("kit", "paper")
    assert {task for task, row in rows.items() if row["origin"] != "ours"} == published


def pairwise_words(text: str) -> list[tuple[str, str]]:
    """First and second word, third and fourth, and so on."""
    words = text.split()
    return list(zip(words[::2], words[1::2], strict=True))


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
