"""Give every command what it cannot use: one clear error, exit code 2, and not a file has changed."""

import contextlib
import io
import json
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from creps_jax import files
from creps_jax.tools import results
from creps_jax.tools.cli import main as tools
from creps_jax.tools.session import plain, storage
from creps_jax.tools.session.settings import Settings
from experiments import walk
from experiments.cli import main
from experiments.walking import learning as walk_learning
from tests.tools.test_robot_session import DEFINITION, fill

Mistake = tuple[list[str], str]
"""The arguments, and what of them the error has to show."""

WORDS = st.sampled_from(["abc", "1.2.3", "ten", "1e", "[1]"])
NO_COUNTS = st.one_of(
    WORDS,
    st.sampled_from(["2.5", "nan", "1e3"]),
    st.integers(-(10**12), 0).map(str),
    st.integers(10**7, 10**30).map(str),
)
NO_SEEDS = WORDS | st.integers(-(10**30), -1).map(str) | st.integers(2**32, 10**30).map(str)
NO_SPEEDS = WORDS | st.one_of(
    st.floats(max_value=0.09), st.floats(min_value=0.61), st.just(float("nan"))
).map(str)
NO_NAMES = st.text("abcdefgh_/.", min_size=1, max_size=12)
# The policy of the fixture is the NAO's.
NO_ROBOTS = NO_NAMES | st.just("nao_h25")
# As files and folders of the fixture: there is none, it is no file, or no whole one.
NO_POLICIES = st.sampled_from(
    ["none.npz", "full", "file", "cut.npz", "file/p.npz", "nan.npz", "reversed.npz"]
)
NO_FOLDERS = st.sampled_from(["file", "file/below", "/proc/nowhere", "long" * 100])
NO_NEW_FOLDERS = NO_FOLDERS | st.just("full")
NO_VIDEOS = st.sampled_from(["walk.gif", "walk.png", "full", "folder.mp4", "file/w.mp4", "/proc/w.mp4"])
NO_NUMBERS = WORDS | st.sampled_from(["-1", "0", "-inf", "inf"])
NO_EXPORTS = st.sampled_from(["policy.txt", "walk", "walk.csv", "folder.h", "file/p.onnx", "/proc/p.h"])
NO_SESSIONS = st.sampled_from(["nowhere", "file", "full", "file/below", "arm/.lock", "other-arm", "cut-arm"])
NO_DEFINITIONS = st.sampled_from(["none.json", "file", "full", "whole.npz", "manifest.json"])
NO_RESULTS = st.sampled_from(["none", "file", "file/below", "full", "cut", "other", "lacking", "empty"])


def option(*arguments: str, values: st.SearchStrategy[str]) -> st.SearchStrategy[Mistake]:
    return values.map(lambda value: ([*arguments, value], value))


COMMANDS = {
    "list": option("list", values=NO_NAMES),
    "run": st.one_of(
        option("run", values=NO_NAMES),
        option("run", "tiny", "--preset", values=NO_NAMES),
        option("run", "tiny", "--iterations", values=NO_COUNTS),
        option("run", "tiny", "--trials", values=NO_COUNTS),
        option("run", "tiny", "--seed", values=NO_SEEDS),
        option("run", "tiny", "--out", values=NO_NEW_FOLDERS),
        option("run", "walk", "--physics", values=NO_NAMES),
        option("run", "walk", "--robot", values=NO_NAMES),
        option("run", "tiny", "--robot", values=st.just("nao_h25")).map(lambda it: (it[0], "--robot")),
        option("run", "tiny", "--speeds", values=WORDS),
        option("run", "walk", "--features.num-centers", values=NO_COUNTS),
    ),
    "run --resume": st.one_of(
        option("run", "tiny", "--resume", "--out", values=NO_RESULTS),
        option("run", "tiny", "--resume", "--out", "cut", "--seed", values=st.integers(1, 5).map(str)),
    ),
    "run --config": st.one_of(
        option("run", "tiny", "--config", values=NO_DEFINITIONS),
        option("run", "tiny", "--config", "lacking/manifest.json", "--preset", values=st.just("long")).map(
            lambda it: (it[0], "--preset")
        ),
    ),
    "plot": st.one_of(
        option("plot", values=NO_NAMES),
        option("plot", "tiny", "--folder", values=NO_RESULTS),
    ),
    "check": option("check", values=NO_NAMES),
    "play": st.one_of(
        option("play", "--policy", "whole.npz", "--speed", values=NO_SPEEDS),
        option("play", "--policy", values=NO_POLICIES),
        option("play", "--policy", "whole.npz", "--seed", values=NO_SEEDS),
        option("play", "--policy", "whole.npz", "--out", values=NO_VIDEOS),
        option("play", "--policy", "whole.npz", "--robot", values=NO_ROBOTS),
        st.integers(25, 1000).map(lambda num: (["play", "--speed", *["0.3"] * num], str(num))),
    ),
    "export": st.one_of(
        option("export", "--to", values=NO_EXPORTS),
        option("export", "--to", "p.h", "--policy", values=NO_POLICIES),
        st.just((["export", "--to", "p.h", "--speed", "0.3"], "--speed")),
        option("export", "--to", "w.csv", "--policy", "whole.npz", "--speed", values=NO_SPEEDS),
        option(
            *("export", "--to", "w.csv", "--policy", "whole.npz", "--speed", "0.3", "--duration"),
            values=NO_NUMBERS | st.just("1000000000.0"),
        ),
    ),
    "session new": st.one_of(
        option("session", "new", "--define", "arm.json", values=NO_NEW_FOLDERS),
        option("session", "new", "new", values=st.just("--policy")),
        option("session", "new", "new", "--define", values=NO_DEFINITIONS),
        option("session", "new", "new", "--policy", values=NO_POLICIES),
        option("session", "new", "new", "--policy", "whole.npz", "--exploration", values=NO_NUMBERS),
        option("session", "new", "new", "--define", "arm.json", "--batch-size", values=NO_COUNTS),
        option("session", "new", "new", "--define", "arm.json", "--archive-size", values=NO_COUNTS),
        option("session", "new", "new", "--define", "arm.json", "--kl-bound", values=NO_NUMBERS),
        option("session", "new", "new", "--define", "arm.json", "--seed", values=NO_SEEDS),
    ),
    "session": st.one_of(
        option("session", values=NO_NAMES),
        option("session", "ask", values=NO_SESSIONS),
        option("session", "ask", "arm", "--more", values=NO_COUNTS),
        option("session", "ask", "arm", "--more", "1", "--context", values=NO_NUMBERS),
        option("session", "status", values=NO_SESSIONS),
        option("session", "tell", "arm", "--broken", values=WORDS | st.sampled_from(["0", "-1", "4", "1e3"])),
        option("session", "tell", "arm", "1", "--reward", values=WORDS | st.sampled_from(["inf", "1e+39"])),
        st.just((["session", "tell", "arm", "1"], "--reward")),
        st.just((["session", "tell", "arm", "1", "--reward", "1", "--broken"], "--broken")),
        option("session", "save", "--to", "p.npz", values=NO_SESSIONS),
    ),
}


@pytest.fixture
def folder(tiny):
    """Work in a folder of files that are none of what they should be, of one whole policy and one session."""
    Path("file").write_text("text")
    for name in ("full", "empty", "folder.mp4", "folder.h"):
        Path(name).mkdir()
    Path("full/notes.txt").write_text("mine")
    quick = walk.SETTINGS["quick"]
    policy = walk_learning.as_learned(quick, walk_learning.first_policy(quick))
    policy.save(Path("whole.npz"))
    Path("cut.npz").write_bytes(Path("whole.npz").read_bytes()[:-100])
    arrays = files.load_arrays(Path("whole.npz"))
    files.save_arrays(Path("nan.npz"), {**arrays, "coef": arrays["coef"] * float("nan")})
    files.save_arrays(Path("reversed.npz"), {**arrays, "param_bounds": arrays["param_bounds"][::-1]})
    manifest = results.make_manifest("tiny", "quick", tiny.SETTINGS["quick"], seed=0)
    for name, experiment, text in (("cut", "tiny", b"PK"), ("other", "walk", b""), ("lacking", "tiny", None)):
        Path(name).mkdir()
        files.save_json(Path(name) / results.MANIFEST, {**manifest, "experiment": experiment})
        if text is None:
            files.save_arrays(Path(name) / results.ARRAYS, {"something": 1.0})
        else:
            (Path(name) / results.ARRAYS).write_bytes(text)
    make_sessions()
    Path("lacking/checkpoint-tiny.npz").write_bytes(b"PK")
    Path("cut/checkpoint-tiny.npz").write_bytes(b"PK")
    return Path()


def make_sessions():
    """Make a session of three trials, one whose trials are of other settings, and one that is cut short."""
    Path("arm.json").write_text(json.dumps(DEFINITION))
    files.save_json(Path("manifest.json"), {"experiment": "tiny"})
    settings = plain.read(Settings, DEFINITION, "DEFINITION")
    for name in ("arm", "other-arm", "cut-arm"):
        storage.create(Path(name), settings)
        fill(Path(name), 3)
    (Path("other-arm") / storage.SETTINGS).write_text(json.dumps({**DEFINITION, "kl_bound": 0.1}))
    trials = Path("cut-arm") / storage.TRIALS
    trials.write_bytes(trials.read_bytes()[:-20])


def contents(folder: Path) -> dict[str, bytes | None]:
    """Return all that is in a folder; of a run that is resumed, its manifest may tell that this failed."""
    paths = [path for path in folder.rglob("*") if path.name != results.MANIFEST]
    return {str(path): path.read_bytes() if path.is_file() else None for path in paths}


def run(arguments: list[str]) -> tuple[int, str]:
    output = io.StringIO()
    with contextlib.redirect_stdout(output), contextlib.redirect_stderr(output):
        try:
            code = (tools if arguments[0] in ("play", "export", "session") else main)(arguments)
        except SystemExit as error:  # as the parser ends
            code = error.code
    return code, output.getvalue()


@pytest.mark.parametrize("command", COMMANDS)
def test_mistakes_get_one_clear_error_and_change_nothing(folder, command):
    before = contents(folder)

    @settings(
        max_examples=30,
        deadline=None,
        derandomize=True,
        database=None,
        suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
    )
    @given(COMMANDS[command])
    def check(mistake):
        arguments, shown = mistake
        code, output = run(arguments)
        assert code == 2, output
        # The parser breaks lines; what is in the way of a file is named, or its folder.
        told = "".join(output.replace("│", "").split())
        assert shown in told or ("/" in shown and str(Path(shown).parent) in told), output
        assert "Traceback" not in output
        assert contents(folder) == before

    check()


def test_results_that_are_cut_short_fail_the_check(tiny):
    folder = Path("results/tiny/one")
    manifest = results.make_manifest("tiny", "quick", tiny.SETTINGS["quick"], seed=0)
    files.save_json(folder / results.MANIFEST, {**manifest, "status": "finished"})
    for arrays, message in ((b"PK", "it is cut short"), (None, "lacks 'reward'")):
        if arrays is None:
            files.save_arrays(folder / results.ARRAYS, {"something": 1.0})
        else:
            (folder / results.ARRAYS).write_bytes(arrays)
        code, output = run(["check", "tiny"])
        assert code == 2 and "arrays.npz" in output and message in output
