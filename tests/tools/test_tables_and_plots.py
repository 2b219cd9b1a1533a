import csv
import io

import numpy as np
import pytest

from creps_jax.tools import plots, tables

PNG = b"\x89PNG"


def evaluation(num=11, seeds=4):
    rng = np.random.default_rng(0)
    asked = np.linspace(0.1, 0.6, num)
    speed = np.stack(
        [asked[:, None] + rng.normal(0, 0.02, (num, seeds)), rng.normal(0, 0.02, (num, seeds))], -1
    )
    fell = rng.uniform(size=(num, seeds)) < 0.1
    reward = -10 * (speed[..., 0] - asked[:, None]) ** 2 - 100.0 * fell
    return asked, reward, speed, fell


def test_paper_table_is_that_of_the_paper():
    errors = np.sqrt(-np.array(tables.PAPER_RBF) / 10)
    np.testing.assert_allclose(
        errors, [0.13, 0.03, 0.04, 0.09, 0.05, 0.23, 0.15, 0.14, 0.19, 0.35, 0.30], atol=0.006
    )
    assert len(tables.PAPER_SPEEDS) == len(tables.PAPER_LINEAR) == len(tables.PAPER_RBF) == 11
    assert np.mean(tables.PAPER_RBF) == pytest.approx(-0.343, abs=5e-4)


def test_speed_table_stands_beside_the_paper_only_at_its_speeds():
    columns = tables.speed_table(*evaluation())
    assert columns["paper RBF"] == list(tables.PAPER_RBF)
    assert columns["falls"][0].endswith("/4")
    np.testing.assert_allclose(columns["reward"], evaluation()[1].mean(axis=1))
    assert "paper RBF" not in tables.speed_table(*evaluation(num=3))


def test_tables_have_the_same_cells_in_both_forms():
    columns = {"name": ["a", "bc"], "value": [1.0, -12.3456]}
    assert list(csv.DictReader(io.StringIO(tables.to_csv(columns))))[1] == {"name": "bc", "value": "-12.3456"}
    lines = tables.to_markdown(columns).splitlines()
    assert [cell.strip() for cell in lines[3].strip("|").split("|")] == ["bc", "-12.346"]
    assert len({len(line) for line in lines}) == 1
    assert tables.to_markdown({"name": [], "value": []}).splitlines() == [
        "| name | value |",
        "|-----:|------:|",
    ]


def test_interval_holds_the_mean_and_stays_among_the_samples():
    samples = -(10.0 ** np.random.default_rng(0).uniform(-4, 1, (5, 30)))
    samples[0, 3], samples[:, 4] = np.nan, -1.0
    low, high = plots.confidence_interval(samples)
    assert np.all(low <= np.nanmean(samples, axis=0) + 1e-12)
    assert np.all(high >= np.nanmean(samples, axis=0) - 1e-12)
    assert np.all(low >= np.nanmin(samples, axis=0))
    assert np.all(high <= np.nanmax(samples, axis=0))


def figures():
    asked, _, speed, fell = evaluation()
    rng = np.random.default_rng(0)
    episodes = np.arange(1, 31)
    curve = -np.exp(-episodes / 5) * rng.uniform(0.5, 1.5, (5, 30))
    yield "curves", plots.learning_curves({"a": {"x": (episodes, curve), "y": (episodes, curve[:1])}})
    gaps = {"a": {"x": (episodes, np.full((3, 30), np.nan))}, "b": {"y": (episodes, curve + 2)}}
    yield "gaps", plots.learning_curves(gaps, references={"paper": -1.0})
    parameters = {"names": list("abcdefg"), "units": ["m"] * 7, "low": [0] * 7, "high": [1] * 7}
    theta = rng.uniform(size=(3, 11, 7))
    for shape in (theta, theta[0]):
        yield (
            "parameters",
            plots.parameters_against_context(
                asked, shape, **parameters, context_label="speed", title="title"
            ),
        )
    yield "speed", plots.reached_against_asked(asked, speed[..., 0], fell, title="title", paper=asked / 2)
    yield "one seed", plots.reached_against_asked(asked[:1], speed[:1, :1, 0], fell[:1, :1], title="title")
    _, axes = plots.new_figure()
    plots.plot_policy(axes[0, 0], asked, theta[..., 0], asked, title="title", labels=("s", "theta"))
    yield "policy", axes[0, 0].figure
    values = {"a": rng.uniform(size=5), "b": rng.uniform(size=5)}
    yield "final", plots.final_values(values, label="regret", log=True)
    _, axes = plots.new_figure()
    plots.plot_postures(axes[0, 0], rng.normal(size=(100, 4, 2)))
    plots.plot_ground(axes[0, 0], 1.7, 0.3, 1.0)
    yield "postures", axes[0, 0].figure


def test_the_kept_policy_is_the_thick_line():
    theta = np.array([0.1, 0.2, 0.3])[:, None, None] * np.ones((3, 5, 1))
    settings = {"names": ["a"], "units": ["m"], "low": [0], "high": [1], "context_label": "s", "title": "t"}
    figure = plots.parameters_against_context(np.arange(5.0), theta, **settings, chosen=1)
    widths = {line.get_ydata()[0]: line.get_linewidth() for line in figure.axes[0].lines}
    assert max(widths, key=widths.get) == pytest.approx(0.2)


def test_figures_can_be_drawn_and_saved(tmp_path):
    for name, figure in figures():
        plots.save_figure(tmp_path / f"{name}.png", figure)
        assert (tmp_path / f"{name}.png").read_bytes().startswith(PNG)


def test_logarithmic_scale_only_where_it_helps():
    for rewards, scale in (
        ([-1e-3, -10.0], "symlog"),
        ([-5.0, -10.0], "linear"),
        ([1.0, -10.0], "linear"),
        ([], "linear"),
    ):
        _, axes = plots.new_figure()
        plots.reward_scale(axes[0, 0], [np.array(rewards)])
        assert axes[0, 0].get_yscale() == scale
