"""A robot session as a lab uses it: killed, filled up, told twice; and what it learns, bit by bit."""

import copy
import dataclasses
import errno
import hashlib
import json
import math
import os
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from creps_jax import files
from creps_jax.errors import UserError
from creps_jax.policies.features import polynomial_features, rbf_features, scaled_polynomial_features
from creps_jax.policies.gaussian import LinearGaussian
from creps_jax.policies.learned import Learned, load
from creps_jax.policies.network import network_policy, start_network
from creps_jax.policies.space import Space
from creps_jax.search.archive import Batch
from creps_jax.search.creps import creps
from creps_jax.search.fit import bounded_ml
from creps_jax.tools.cli import main
from creps_jax.tools.session import RobotSession, page, plain, robot_session, storage
from creps_jax.tools.session.learner import Update
from creps_jax.tools.session.settings import Settings, load_settings
from creps_jax.tools.session.trials import Record, Trial

ROOT = Path(__file__).parents[2]

# One for all tests, as each other one would have to be compiled. An update needs 3 + 2 valid trials.
DEFINITION = {
    "contexts": [{"name": "distance", "unit": "m", "low": 0.5, "high": 2.0}],
    "parameters": [
        {"name": "speed", "unit": "m/s", "low": 1.0, "high": 6.0, "start": 3.0, "spread": 0.5},
        {"name": "angle", "unit": "deg", "low": 10, "high": 80},
    ],
    "features": {"kind": "rbf", "num_centers": 3},
    "batch_size": 4,
    "archive_size": 12,
}


@pytest.fixture
def session(tmp_path) -> RobotSession:
    return RobotSession.create(tmp_path / "arm", define=DEFINITION)


def reward_of(trial: Trial) -> float:
    """Miss the distance by how the ball flies; every fifth measurement fails."""
    flight = trial.parameters["speed"] ** 2 * math.sin(math.radians(2 * trial.parameters["angle"])) / 9.81
    return math.nan if trial.id % 5 == 0 else -((flight - trial.context["distance"]) ** 2)


def run_batches(session: RobotSession, number: int) -> None:
    for _ in range(number):
        for trial in session.ask():
            session.tell(trial.id, reward_of(trial))


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def bits(tree) -> list[bytes]:
    return [np.asarray(leaf).tobytes() for leaf in jax.tree.leaves(tree)]


def test_asked_trials_stay_the_same_until_they_are_told(session):
    trials = session.ask()
    assert [trial.id for trial in trials] == [1, 2, 3, 4]
    for trial in trials:
        assert 0.5 <= trial.context["distance"] <= 2.0
        assert 1.0 <= trial.parameters["speed"] <= 6.0
        assert 10.0 <= trial.parameters["angle"] <= 80.0
    assert len({trial.theta for trial in trials}) == 4
    before = contents(session.folder)
    assert session.ask() == trials == RobotSession.open(session.folder).ask()
    assert contents(session.folder) == before
    session.tell(2, -1.0)
    assert [trial.id for trial in session.ask()] == [1, 3, 4]
    assert [trial.id for trial in session.ask(more=2)] == [1, 3, 4, 5, 6]
    for trial in session.pending():
        session.tell(trial.id, -1.0)
    # Six have been told: a whole batch, and two of the next.
    assert [trial.id for trial in session.ask()] == [7, 8]


def test_contexts_are_drawn_or_given(session):
    (trial,) = session.ask([1.25])
    assert trial.context == {"distance": 1.25}
    assert session.ask([1.25]) == session.ask() == [trial]
    with pytest.raises(
        UserError, match=r"trial 1 is pending, at distance 1\.25: tell it first, or add --more"
    ):
        session.ask([1.5])
    assert [trial.context["distance"] for trial in session.ask([1.5], more=2)] == [1.25, 1.5, 1.5]
    with pytest.raises(UserError, match=r"distance must be within its range, 0\.5 to 2 m, got 2\.5"):
        session.ask([2.5], more=1)
    with pytest.raises(UserError, match=r"context must be a number for each of distance, got \(1, 2\)"):
        session.ask([1, 2], more=1)
    with pytest.raises(UserError, match="more must be from 1 to 10000, got 0"):
        session.ask(more=0)
    drawn = {trial.context["distance"] for trial in session.ask(more=20)[3:]}
    assert len(drawn) == 20
    assert min(drawn) < 0.9 and max(drawn) > 1.6


def test_the_first_policy_has_start_and_spread_in_the_units_of_the_parameters(session, tmp_path):
    clipped = RobotSession.create(
        tmp_path / "clip",
        define={**broken("parameters", 1, spread=30.0), "constraint": "clip", "features": {"kind": "linear"}},
    )
    low, high = np.array([1.0, 10.0]), np.array([6.0, 80.0])
    start, spread = np.array([3.0, 45.0]), np.array([0.5, 70.0 / 8])
    first = session.policy().policy
    share = 1 / (1 + np.exp(-first.coef))
    np.testing.assert_allclose(low + (high - low) * share, np.tile(start, (3, 1)), rtol=1e-5)
    slope = (high - low) * share[0] * (1 - share[0])
    np.testing.assert_allclose(np.diag(first.cov_chol) * slope, spread, rtol=1e-5)
    first = clipped.policy().policy
    constraints = [each.policy().parameters.constraint for each in (clipped, session)]
    assert constraints == ["clip", "sigmoid"]
    np.testing.assert_allclose(first.coef, [start, np.zeros(2)])
    np.testing.assert_allclose(first.cov_chol, np.diag([0.5, 30.0]))
    # What is cut off at the bounds is not learned from either.
    trials = clipped.ask(more=100)
    assert min(trial.parameters["angle"] for trial in trials) == 10.0
    assert all(trial.theta == tuple(trial.parameters.values()) for trial in trials)


def test_what_is_learned_is_what_the_algorithm_learns_of_these_batches(session):
    first = session.policy().policy
    run_batches(session, 3)
    features = rbf_features(0.5, 2.0, 3)
    m_step = bounded_ml(mean_kl_bound=0.5, cov_kl_bound=0.05)
    algorithm = creps(features, features, kl_bound=0.5, archive_size=12, m_step=m_step)
    state = algorithm.init(first)
    for batch in np.array_split(session._record().trials, 3):
        rewards = [np.nan if trial.reward is None else trial.reward for trial in batch]
        state, info = algorithm.tell(
            state,
            Batch(
                jnp.array([[trial.context["distance"]] for trial in batch]),
                jnp.array([trial.theta for trial in batch]),
                np.array(rewards),  # in float64, as the session tells them
            ),
        )
    updates = session.status().updates
    assert [update.is_updated for update in updates] == [False, True, True]
    assert [update.num_valid for update in updates] == [4, 7, 10]
    assert bits(updates[-1].policy) == bits(state.policy)
    assert updates[-1].kl == pytest.approx(float(info.policy_kl))
    assert updates[0].kl_from_first == 0.0 < updates[1].kl_from_first


def test_replaying_gives_the_same_bits(session):
    for trial in session.ask():
        session.tell(trial.id, reward_of(trial))
    session.ask()
    # In another order, over other objects, with a mistake that is mended.
    for number in (7, 5, 8):
        other = RobotSession.open(session.folder)
        other.tell(number, -9.0 if number == 5 else reward_of(other._record().trial(number)))
    session.tell(5, reward_of(session._record().trial(5)), replace=True)
    assert session.tell(6, -0.25).update is not None
    run_batches(session, 1)
    replayed = RobotSession.open(session.folder)
    assert len(session.status().updates) == 3
    assert bits(replayed.status().updates) == bits(session.status().updates)
    assert bits(replayed.policy().policy.coef) == bits(session.policy().policy.coef)
    assert replayed.ask() == RobotSession.open(session.folder).ask()


def test_telling_is_idempotent_and_what_was_learned_from_stays(session):
    session.ask()
    assert session.tell(3, -1.5).is_new
    before = contents(session.folder)
    assert not session.tell(3, -1.5).is_new
    with pytest.raises(
        UserError, match=r"trial 3 has been told already, reward -1\.5, not reward -2\.0; add --rep"
    ):
        session.tell(3, -2.0)
    with pytest.raises(UserError, match=r"trial 3 has been told already, reward -1\.5, not broken"):
        session.tell(3, math.nan)
    with pytest.raises(UserError, match=r"trial 3 has been told already, reward -1\.5, not to be repeated"):
        session.repeat(3)
    for trial_id in (0, 5, -1):
        with pytest.raises(UserError, match=f"there is no trial {trial_id}: those asked for are 1 to 4"):
            session.tell(trial_id, 1.0)
    for reward in (math.inf, -math.inf, 1e39):
        with pytest.raises(UserError, match="trial 1 must be finite, or NaN if broken"):
            session.tell(1, reward)
    assert contents(session.folder) == before

    assert session.tell(3, -2.0, replace=True).trial.reward == -2.0
    assert session.tell(1, math.nan).trial.is_broken
    assert not session.tell(1, math.nan).is_new
    assert session.repeat(3, replace=True).is_pending
    assert session.repeat(3).repeats == 2
    assert session.tell(2, -1.0).update is None
    assert session.tell(3, -1.0).update is None
    assert session.tell(4, -1.0).update is not None
    for change in (lambda: session.tell(3, -2.0, replace=True), lambda: session.repeat(3, replace=True)):
        with pytest.raises(
            UserError, match=r"trial 3 stays reward -1\.0, not .*: batch 1 has been learned from"
        ):
            change()
    assert not session.tell(3, -1.0).is_new


def fill(folder: Path, number: int) -> None:
    """Ask for trials that nobody has drawn."""
    settings = load_settings(folder / storage.SETTINGS)
    trials = [
        Trial(id=i, context={"distance": 1.0}, parameters={"speed": 3.0, "angle": 45.0}, theta=(0.0, 0.0))
        for i in range(1, number + 1)
    ]
    storage.save_record(folder, Record(settings=settings.digest(), trials=tuple(trials)))


TELL_ALL = """
import sys
from creps_jax.tools.session import RobotSession
session = RobotSession.open(sys.argv[1])
for trial in session.pending():
    session.tell(trial.id, -trial.id / 7)
    print(trial.id, flush=True)
    assert "jax" not in sys.modules
"""


def test_a_killed_process_loses_nothing_that_it_acknowledged(tmp_path):
    folder = RobotSession.create(
        tmp_path / "arm", define={**DEFINITION, "batch_size": 1000, "archive_size": 1000}
    ).folder
    fill(folder, 150)
    rng = np.random.default_rng(0)
    acknowledged: set[int] = set()
    for _ in range(4):
        process = subprocess.Popen(
            [sys.executable, "-c", TELL_ALL, str(folder)], cwd=ROOT, stdout=subprocess.PIPE, text=True
        )
        lines = [process.stdout.readline() for _ in range(rng.integers(1, 8))]
        time.sleep(rng.uniform(0, 0.02))
        process.kill()
        lines += process.stdout.readlines()
        process.stdout.close()
        assert process.wait() == -9
        acknowledged |= {int(line) for line in lines if line.endswith("\n")}
        told = RobotSession.open(folder)._record().told()
        assert {trial.id for trial in told} >= acknowledged
        # At most one tell of each process was on the disk before it could say so.
        assert len(told) <= len(acknowledged) + 4
        assert all(trial.reward == -trial.id / 7 for trial in told)
    assert len(acknowledged) >= 4
    with storage.locked(folder, wait=1.0):
        assert {path.name for path in folder.iterdir()} == {"settings.json", "trials.json", ".lock"}


@pytest.mark.parametrize("reward", ["x", None, [1.0, 2.0]])
def test_a_reward_that_is_no_number_is_refused(session, reward):
    session.ask()
    with pytest.raises(UserError, match="the reward of trial 1 must be a number, got"):
        session.tell(1, reward)


def test_one_process_at_a_time_others_wait_or_say_so(session, monkeypatch):
    session.ask()
    monkeypatch.setattr(robot_session, "LOCK_SECONDS", 0.1)
    with (
        storage.locked(session.folder, wait=0.0),
        pytest.raises(UserError, match="arm is in use by another process"),
    ):
        session.tell(1, -1.0)
    monkeypatch.setattr(robot_session, "LOCK_SECONDS", 30.0)
    with storage.locked(session.folder, wait=0.0):
        thread = threading.Thread(target=session.tell, args=(1, -1.0))
        thread.start()
        time.sleep(0.1)
        assert len(session.pending()) == 4
    thread.join()
    assert len(session.pending()) == 3


@pytest.mark.parametrize("place", [(os, "fsync"), (os, "replace"), (tempfile, "mkstemp")], ids=lambda p: p[1])
def test_a_full_disk_is_named_and_leaves_everything_as_it_was(session, tmp_path, monkeypatch, place):
    run_batches(session, 1)
    session.ask()
    before = contents(session.folder)

    def full(*_, **__):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(*place, full)
    for action in (
        lambda: session.ask(more=1),
        lambda: session.tell(5, -1.0),
        lambda: session.repeat(5),
        lambda: RobotSession.create(tmp_path / "new", define=DEFINITION),
    ):
        with pytest.raises(UserError, match="No space left on device"):
            action()
    assert contents(session.folder) == before
    assert [path.name for path in tmp_path.iterdir()] == ["arm"]
    monkeypatch.undo()
    assert session.tell(5, -1.0).is_new


def test_nothing_is_acknowledged_until_the_folder_is_on_the_disk(session, monkeypatch):
    session.ask()

    def fail(_):
        raise UserError("what was written may not last")

    monkeypatch.setattr(files, "sync_folder", fail)
    for _ in range(2):
        with pytest.raises(UserError, match="may not last"):
            session.tell(1, -1.0)
    monkeypatch.undo()
    assert not session.tell(1, -1.0).is_new


@pytest.mark.parametrize("name", ["settings.json", "trials.json"])
@pytest.mark.parametrize("spoil", ["missing", "cut", "empty", "binary", "foreign", "list"])
def test_a_spoiled_file_is_named_and_left_alone(session, name, spoil):
    fill(session.folder, 4)
    path = session.folder / name
    whole = path.read_bytes()
    path.unlink()
    if spoil != "missing":
        texts = {"cut": whole[:-20], "empty": b"", "binary": b"\xff\x00\x81", "list": b"[1]"}
        path.write_bytes(texts.get(spoil, b'{"hello": 1}'))
    before = contents(session.folder)
    with pytest.raises(UserError, match=name.replace(".", r"\.")) as caught:
        RobotSession.open(session.folder).tell(1, -1.0)
    assert "\n" not in str(caught.value)
    assert contents(session.folder) == before


@pytest.mark.parametrize(
    ("change", "error"),
    [
        (lambda trial: trial.update(id=3), "ids must run from 1"),
        (lambda trial: trial.update(told=2), "place of its own"),
        (lambda trial: trial.update(told=None), "trial 1 has a reward but no place"),
        (lambda trial: trial.update(theta=[0.0]), "trial 1 has other variables than settings.json"),
        (lambda trial: trial.update(context={"height": 1.0}), "trial 1 has other variables"),
        (
            lambda trial: trial.update(reward="good"),
            r"trials\[0\]\.reward must be a finite number, got 'good'",
        ),
        (lambda trial: trial.pop("theta"), r"trials\[0\]\.theta is missing"),
        (lambda trial: trial.update(note="x"), r"unknown field 'trials\[0\]\.note'"),
    ],
)
def test_a_record_edited_by_hand_has_to_make_sense(session, change, error):
    fill(session.folder, 2)
    session.tell(1, -1.0)
    session.tell(2, -1.0)
    path = session.folder / "trials.json"
    values = json.loads(path.read_text())
    change(values["trials"][0])
    path.write_text(json.dumps(values))
    with pytest.raises(UserError, match=error) as caught:
        RobotSession.open(session.folder)
    assert str(path) in str(caught.value)


def test_settings_can_be_edited_until_the_first_trial(session):
    path = session.folder / "settings.json"
    path.write_text(path.read_text().replace('"seed": 0', '"seed": 1'))
    first = RobotSession.open(session.folder).ask()
    other = RobotSession.create(session.folder.parent / "other", define=DEFINITION, seed=1)
    assert other.ask() == first
    path.write_text(path.read_text().replace('"kl_bound": 0.5', '"kl_bound": 0.6'))
    with pytest.raises(UserError, match=r"settings\.json is not what the trials were asked for with"):
        RobotSession.open(session.folder)
    # Nor does a session that was opened before it was edited mix both.
    with pytest.raises(UserError, match=r"settings\.json is not what"):
        session.tell(1, -1.0)


def broken(*path, **values) -> dict:
    """Return the definition with other values at a place; one that is ... is left out."""
    changed = copy.deepcopy(DEFINITION)
    place = changed
    for step in path:
        place = place[step]
    for name, value in values.items():
        place.pop(name, None)
        if value is not ...:
            place[name] = value
    return changed


@pytest.mark.parametrize(
    ("definition", "error"),
    [
        (broken(contexts=...), "contexts is missing"),
        (broken(contexts=[]), "contexts must name at least one, got none"),
        (broken(contexts={}), r"contexts must be a list, got \{\}"),
        (broken(paramters=[]), "unknown field 'paramters', did you mean 'parameters'"),
        (broken("contexts", 0, low=...), r"contexts\[0\]\.low is missing"),
        (broken("contexts", 0, low="0.5"), r"contexts\[0\]\.low must be a finite number, got '0.5'"),
        (broken("contexts", 0, low=True), r"contexts\[0\]\.low must be a finite number, got True"),
        (broken("contexts", 0, high=math.inf), r"contexts\[0\]\.high must be a finite number, got inf"),
        (broken("contexts", 0, high=10**400), r"contexts\[0\]\.high must be a finite number"),
        (
            broken("contexts", 0, high=0.5),
            r"contexts\[0\]: low of distance must be below high, got 0.5 and 0.5",
        ),
        (broken("contexts", 0, start=1.0), r"unknown field 'contexts\[0\]\.start'"),
        (broken("parameters", 1, name=" "), r"parameters\[1\]: name must not be empty, got ' '"),
        (broken("parameters", 1, name="speed"), "names of variables must be different, got 'speed' twice"),
        (broken("parameters", 1, name="distance"), "must be different, got 'distance' twice"),
        (broken("parameters", 0, start=7.0), "start of speed must be within its bounds, 1 to 6 m/s, got 7"),
        (
            broken("parameters", 0, start=6.0),
            "speed must be inside its bounds, which a sigmoid never reaches, got 6",
        ),
        (broken("parameters", 0, spread=0.0), "spread of speed must be above zero, got 0"),
        (broken("parameters", 0, spread=1e-60), "in single precision: std must be above zero"),
        (
            broken("features", kind="cubic"),
            "features must be one of linear, polynomial, rbf, kernel, got 'cubic'",
        ),
        (
            broken("features", kind="polynomial", degree=0, num_centers=None),
            "degree must be at least 1, got 0",
        ),
        (
            broken("features", kind="polynomial"),
            "num_centers and bandwidth must be None for polynomial features",
        ),
        (broken("features", degree=2), "degree must be None for rbf features, got 2"),
        (broken("features", num_points=5), "num_points must be None for rbf features, got 5"),
        (
            broken("features", kind="kernel", num_points=5),
            "num_centers must be None for kernel features, got",
        ),
        (
            broken("features", kind="kernel", num_points=0, num_centers=None),
            "num_points must be from 1 to 2000, got 0",
        ),
        (broken("features", num_points=2.5), r"features\.num_points must be a whole number, got 2\.5"),
        (broken("features", degree=2.5), r"features\.degree must be a whole number, got 2\.5"),
        (broken("features", num_centers=0), "num_centers must be at least 1, got 0"),
        (broken("features", num_centers=2.5), r"features\.num_centers must be a whole number, got 2\.5"),
        (
            broken("features", num_centers=[2.5]),
            r"features\.num_centers\[0\] must be a whole number, got 2\.5",
        ),
        (broken("features", num_centers=[5, 3]), r"num_centers must be one number or 1, .*, got \(5, 3\)"),
        (broken("features", num_centers=[0]), r"num_centers must be whole numbers of at least 1, got \(0,\)"),
        (
            broken(features=3),
            "features must be an object with the fields kind, num_centers, bandwidth, degree, .*, got 3",
        ),
        (broken(constraint="penalty"), "constraint must be one of sigmoid, clip, got 'penalty'"),
        (broken(kl_bound=0), "kl_bound must be above zero, got 0"),
        (broken(mean_kl_bound=None), "must both be numbers or both be null, got None and 0.05"),
        (broken(batch_size=0), "batch_size must be from 1 to 10000, got 0"),
        (broken(batch_size=20), "archive_size must be at least batch_size, 20, got 12"),
        (
            broken(archive_size=4),
            "archive_size must be at least 5, the number of features and parameters, got 4",
        ),
        (broken(seed=-1), "seed must be from 0 to 4294967295, got -1"),
        (broken(first_policy={"coef": [[0.0], [0.0, 1.0]], "cov_chol": [[1.0]]}), "rows of one length"),
        (broken(first_policy={"coef": [[0.0]], "cov_chol": [[1.0]]}), "do not go with first_policy"),
        ([1], r"it must be an object with the fields contexts, .*, got \[1\]"),
    ],
)
def test_each_mistake_in_a_definition_is_named(tmp_path, definition, error):
    (tmp_path / "arm.json").write_text(json.dumps(definition))
    with pytest.raises(UserError, match=error) as caught:
        RobotSession.create(tmp_path / "arm", define=tmp_path / "arm.json")
    assert "\n" not in str(caught.value)
    assert [path.name for path in tmp_path.iterdir()] == ["arm.json"]


def test_a_definition_names_each_field_once_and_the_folder_is_new(tmp_path, session):
    (tmp_path / "arm.json").write_text('{"seed": 0, "contexts": [], "seed": 1}')
    with pytest.raises(UserError, match=r"arm\.json: the field 'seed' is there twice"):
        RobotSession.create(tmp_path / "new", define=tmp_path / "arm.json")
    before = contents(session.folder)
    with pytest.raises(UserError, match="arm is there already"):
        RobotSession.create(session.folder, define=DEFINITION)
    assert contents(session.folder) == before
    with pytest.raises(UserError, match="either with a policy"):
        RobotSession.create(tmp_path / "new")
    with pytest.raises(UserError, match="exploration goes with a policy"):
        RobotSession.create(tmp_path / "new", define=DEFINITION, exploration=0.5)
    with pytest.raises(UserError, match="unknown field 'batch_sise', did you mean 'batch_size'"):
        RobotSession.create(tmp_path / "new", define=DEFINITION, batch_sise=3)


def simulated_policy() -> Learned:
    """Return a policy of the variables of DEFINITION, with numbers that decimals do not have."""
    rng = np.random.default_rng(0)
    return Learned(
        LinearGaussian(rng.normal(size=(3, 2)) / 3, np.tril(rng.uniform(0.1, 0.3, size=(2, 2)))),
        rbf_features(0.5, 2.0, 3),
        Space(("distance",), (0.5,), (2.0,), ("m",)),
        Space(("speed", "angle"), (1.0, 10.0), (6.0, 80.0), ("m/s", "deg"), "sigmoid"),
        {"name": "throw", "balance": {"heading_gain": 0.3}},
    )


def assert_same(one: Learned, other: Learned) -> None:
    jax.tree.map(np.testing.assert_array_equal, one.policy, other.policy)
    for field in ("features", "contexts", "parameters", "task"):
        assert getattr(one, field) == getattr(other, field)


def test_json_for_people_says_the_same_in_lines_that_are_not_long():
    values = {
        "name": 60 * "long ",
        "unit": "°",
        "rows": [[0.1] * 40, [1, 2]],
        "trials": [{"id": i, "none": None, "empty": [], "deep": {"a": 5 * [{"b": 1.5}]}} for i in range(2)],
    }
    text = plain.to_text(values)
    assert json.loads(text) == values
    # Rows of numbers and long names stay in a line.
    assert all(len(line) <= 110 for line in text.splitlines() if "long" not in line and "0.1" not in line)
    assert len(text.splitlines()) < 30
    numbers = np.random.default_rng(0).normal(size=100).astype(np.float32)
    assert np.array_equal(np.float32(plain.shortest(numbers)), numbers)
    assert plain.shortest([0.1]) == [0.1]


def test_a_session_from_a_policy_begins_with_it(tmp_path):
    policy = simulated_policy()
    same = RobotSession.create(tmp_path / "same", policy=policy).policy()
    assert_same(same, policy)
    policy.save(tmp_path / "policy.npz")
    narrow = RobotSession.create(tmp_path / "narrow", policy=tmp_path / "policy.npz", exploration=0.5)
    np.testing.assert_array_equal(narrow.policy().policy.coef, policy.policy.coef)
    np.testing.assert_array_equal(narrow.policy().policy.cov_chol, 0.5 * policy.policy.cov_chol)
    assert narrow.settings.archive_size == 50
    assert RobotSession.open(tmp_path / "narrow").settings == narrow.settings
    unbound = dataclasses.replace(
        policy, parameters=dataclasses.replace(policy.parameters, constraint="none")
    )
    plain = RobotSession.create(tmp_path / "plain", policy=unbound)
    assert plain.settings.constraint == "clip"
    elsewhere = dataclasses.replace(policy, features=rbf_features(0.0, 3.0, 3))
    with pytest.raises(
        UserError,
        match="must begin with linear or polynomial features, or with scaled polynomials, RBFs",
    ):
        RobotSession.create(tmp_path / "other", policy=elsewhere)
    features = network_policy(policy.contexts.low, policy.contexts.high).features
    state = start_network(jax.random.key(0), features, 2, hidden=2)
    network = dataclasses.replace(policy, policy=state, features=features)
    with pytest.raises(UserError, match="must be linear in features to begin a session, got a network"):
        RobotSession.create(tmp_path / "other", policy=network)
    for exploration in (0.0, -1.0, math.nan, math.inf):
        with pytest.raises(UserError, match="exploration must be above zero and finite"):
            RobotSession.create(tmp_path / "new", policy=policy, exploration=exploration)


def test_the_commands_lead_through_a_session(tmp_path, monkeypatch, capsys):
    def command(*arguments: object, code: int = 0) -> str:
        assert main(["session", *map(str, arguments)]) == code
        out, err = capsys.readouterr()
        notices.append(err)
        return err if code else out

    notices: list[str] = []

    monkeypatch.chdir(tmp_path)
    Path("arm.json").write_text(json.dumps(DEFINITION))
    assert "contexts: distance 0.5 to 2 m\nparameters: speed 1 to 6 m/s" in command(
        "new", "arm", "--define", "arm.json"
    )
    asked = command("ask", "arm")
    assert asked == command("ask", "arm")
    assert "| distance (m) |" in asked and "|  speed (m/s) |" in asked
    assert "error: tell one of --reward X, --broken and --repeat" in command("tell", "arm", 1, code=2)
    assert "trial 1 is pending: run it again" in command("tell", "arm", 1, "--repeat")
    assert command("tell", "arm", 1, "--reward", "-1.5e-1") == "trial 1: reward -0.15\n"
    assert "known already; nothing changed" in command("tell", "arm", 1, "--reward", -0.15)
    assert "add --replace" in command("tell", "arm", 1, "--broken", code=2)
    assert command("tell", "arm", 1, "--broken", "--replace") == "trial 1: broken\n"
    assert len(command("ask", "arm", "--more", 1, "--context", 1.25).splitlines()) == 8
    for number in (2, 3):
        command("tell", "arm", number, "--reward", -1)
    assert notices[-1] == ""
    assert "the batch is complete, but 3 valid trials are too few" in command(
        "tell", "arm", 4, "--reward", -1
    )
    assert notices[-1] == "learning from 3 trials ...\n"
    command("ask", "arm", "--more", 3)
    for number in (5, 6, 7):
        command("tell", "arm", number, "--reward", -number)
    assert "the batch is complete: the policy moved by 0." in command("tell", "arm", 8, "--reward", -9)
    status = command("status", "arm")
    assert status.startswith("8 trials told, 1 of them broken; 0 pending; 1 sent back to be repeated\n")
    assert "1 batch left the policy as it was: an update needs 5 trials" in status
    page_text = Path("arm/status.md").read_text()
    rows = [
        [cell.strip() for cell in line.split("|")[1:-1]] for line in page_text.splitlines() if "|" in line
    ]
    assert rows[2][:6] == ["1", "4", "1", "-1", "-1", "kept"]
    assert rows[3][:5] == ["2", "4", "0", "-5", "-6.75"]
    assert Path("arm/status.png").read_bytes().startswith(b"\x89PNG")
    command("save", "arm", "--to", "learned.npz")
    session = RobotSession.open("arm")
    np.testing.assert_array_equal(load(Path("learned.npz")).policy.coef, session.policy().policy.coef)
    assert "holds no robot session" in command("status", "nowhere", code=2)


def test_the_page_shows_a_session_without_trials_and_one_of_two_contexts(session, tmp_path):
    page.save_page(session.folder, session.status())
    assert "0 trials told" in (session.folder / "status.md").read_text()
    height = {"name": "height", "low": 0.0, "high": 1.0}
    two = RobotSession.create(
        tmp_path / "two",
        define={**DEFINITION, "contexts": [*DEFINITION["contexts"], height], "archive_size": 40},
    )
    assert len(page.draw(two.status()).axes) == 2
    assert len(page.draw(session.status()).axes) == 4


@pytest.mark.parametrize(
    ("changes", "warnings"),
    [
        ({}, []),
        # Much was lost by chance, as much as was lost in all, or little of what was lost.
        ({"unsupported_loss": 1.0, "entropies": (0.0, -6.0)}, ["exploration went without evidence: 6.00"]),
        ({"unsupported_loss": 1.0, "entropies": (0.0, -60.0)}, []),
        ({"p_value": 0.5}, ["the last 5 batches gave no evidence"]),
    ],
)
def test_the_page_warns_of_a_search_that_goes_by_chance(session, changes, warnings):
    entropies = np.linspace(*changes.pop("entropies", (0.0, -1.0)), 6)
    update = dict.fromkeys(Update._fields, 0.0) | {"policy": None, "is_updated": True, "p_value": 0.001}
    updates = tuple(Update(**{**update, **changes, "entropy": entropy}) for entropy in entropies)
    lines = page.summary(session.status()._replace(updates=updates))
    found = [line for line in lines if "evidence" in line]
    assert len(found) == len(warnings)
    for line, warning in zip(found, warnings, strict=True):
        assert line.startswith(warning)


def test_each_context_may_have_its_own_number_of_centres(tmp_path):
    contexts = [{"name": f"c{i}", "low": 0.0, "high": 1.0} for i in range(2)]
    features = {"kind": "rbf", "num_centers": [4, 2]}
    define = {
        "contexts": contexts,
        "parameters": [{"name": "x", "low": -5.0, "high": 5.0}],
        "features": features,
    }
    session = RobotSession.create(tmp_path / "arm", define=define)
    assert RobotSession.open(tmp_path / "arm").settings == session.settings
    assert session.settings.features.num_centers == (4, 2)
    session.policy().save(tmp_path / "policy.npz")
    policy = load(tmp_path / "policy.npz")
    assert policy.features == rbf_features((0.0, 0.0), (1.0, 1.0), (4, 2))
    again = RobotSession.create(tmp_path / "again", policy=policy)
    assert again.settings.features == session.settings.features
    assert again.policy().features == policy.features


@pytest.mark.parametrize(("num_contexts", "num_centers", "archive_size"), [(1, 5, 50), (2, 3, 50)])
def test_more_contexts_have_fewer_centres_along_each(tmp_path, num_contexts, num_centers, archive_size):
    contexts = [{"name": f"c{i}", "low": 0.0, "high": 1.0} for i in range(num_contexts)]
    define = {"contexts": contexts, "parameters": [{"name": "x", "low": -5.0, "high": 5.0}]}
    settings = RobotSession.create(tmp_path / "arm", define=define).status().settings
    assert settings.features.num_centers == num_centers
    assert settings.archive_size == archive_size


def define_with_three_contexts(**features) -> dict:
    contexts = [{"name": f"c{i}", "low": -1.0, "high": 1.0} for i in range(3)]
    parameters = [{"name": "x", "low": -5.0, "high": 5.0}]
    return {"contexts": contexts, "parameters": parameters, "features": features, "batch_size": 20}


@pytest.mark.parametrize(
    ("features", "kind", "degree", "size"),
    [
        ({}, "polynomial", 2, 10),
        ({"degree": 3}, "polynomial", 3, 20),
        ({"kind": "polynomial"}, "polynomial", 2, 10),
        ({"num_centers": 2}, "rbf", None, 8),
        ({"kind": "rbf"}, "rbf", None, 8),
        ({"kind": "kernel"}, "kernel", None, 21),
        ({"num_points": 7, "bandwidth": 1.0}, "kernel", None, 8),
    ],
)
def test_three_contexts_have_polynomial_features_by_default(tmp_path, features, kind, degree, size):
    session = RobotSession.create(tmp_path / "arm", define=define_with_three_contexts(**features))
    settings = RobotSession.open(tmp_path / "arm").settings
    assert settings == session.settings
    assert (settings.features.kind, settings.features.degree) == (kind, degree)
    session.policy().save(tmp_path / "policy.npz")
    policy = load(tmp_path / "policy.npz")
    assert policy.features.size == size
    again = RobotSession.create(tmp_path / "again", policy=policy)
    assert again.policy().features == policy.features


@pytest.mark.parametrize("is_before", [True, False])
def test_polynomials_of_sessions_are_scaled_unless_an_earlier_version_began_them(tmp_path, is_before):
    contexts = [{"name": f"c{i}", "low": 100.0, "high": 300.0} for i in range(3)]
    define = define_with_three_contexts(scaled=not is_before) | {"contexts": contexts}
    session = RobotSession.create(tmp_path / "arm", define=define)
    session.ask()
    path = tmp_path / "arm" / "settings.json"
    settings = json.loads(path.read_text())
    if is_before:
        for name in ("num_points", "scaled"):
            del settings["features"][name]
    path.write_text(json.dumps(settings))
    policy = RobotSession.open(tmp_path / "arm").policy()
    ends = (100.0,) * 3, (300.0,) * 3
    expected = polynomial_features(3, 2) if is_before else scaled_polynomial_features(*ends, 2)
    assert policy.features == expected
    again = RobotSession.create(tmp_path / "again", policy=policy)
    assert again.policy().features == expected


def test_a_session_with_three_contexts_learns(tmp_path):
    session = RobotSession.create(tmp_path / "arm", define=define_with_three_contexts())
    rewards = []
    for _ in range(10):
        trials = session.ask()
        for trial in trials:
            c = trial.context
            reward = -((trial.parameters["x"] - 1 - c["c0"] * c["c1"] - c["c2"]) ** 2)
            session.tell(trial.id, reward=reward)
            rewards.append(reward)
    assert np.mean(rewards[-40:]) > 0.5 * np.mean(rewards[:40])


def test_settings_without_newer_fields_have_the_digest_of_earlier_versions():
    settings = plain.read(Settings, DEFINITION, "settings")
    values = dataclasses.asdict(settings)
    for name in ("degree", "num_points", "scaled"):
        del values["features"][name]
    expected = hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()[:16]
    assert settings.digest() == expected
