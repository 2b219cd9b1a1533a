"""What the benchmarks print and refuse; they themselves measure for minutes."""

import contextlib

import pytest

from creps_jax.errors import UserError
from experiments.benchmarks import scaling
from experiments.benchmarks.scaling import Case, Measured

IT = Measured(
    compiling=14.6,
    running=0.5,
    without_physics=0.05,
    compiled_memory=500.0,
    peak_memory=1234.5,
    buffers=0.75,
    device_memory=None,
)


def test_table_has_a_row_for_each_case_and_compares_with_one_device():
    rows = {
        Case("c", 1, 32, 2.0): IT,
        Case("c", 2, 32, 2.0): IT._replace(running=0.25),
        Case("c", 2, 4096, 2.0): "killed",
        Case("mjx", 2, 32, 2.0): IT,
    }
    table = scaling.columns(rows)
    assert table["physics"] == ["c", "c", "c", "mjx"]
    assert table["batch"] == ["32", "32", "4096", "32"]
    assert table["x real time"] == ["128", "256", "killed", "128"]
    assert table["steps/s"] == ["32,000", "64,000", "-", "32,000"]
    assert table["x one device"] == ["1.00", "2.00", "-", "-"]
    assert table["without physics"] == ["10%", "20%", "-", "10%"]
    assert table["peak MiB"][0] == "1,234"
    assert "device MiB" not in table
    told = scaling.columns({Case("mjx", 1, 32, 1.0): IT._replace(device_memory=2048.0)})
    assert told["device MiB"] == ["2,048"]


@pytest.mark.parametrize(
    ("asked", "message"),
    [
        ({"sizes": (32, 0)}, r"sizes must be at least 1, got \(32, 0\)"),
        ({"sizes": ()}, "sizes must be"),
        ({"physics": ("bullet",)}, "physics must be among auto, mjx, c, got 'bullet'"),
        ({"devices": (1, 3)}, r"devices must be from 1 to 2, got \(1, 3\)"),
        ({"duration": 0.01}, "an episode must last at least 0.04 s, got 0.01"),
    ],
)
def test_what_cannot_be_measured_is_refused(asked, message):
    known = {"sizes": (32,), "physics": ("c",), "devices": (1, 2), "duration": 1.0, "num_devices": 2}
    scaling.check(**known)
    with pytest.raises(UserError, match=message):
        scaling.check(**{**known, **asked})


@pytest.mark.parametrize("end", [scaling.BrokenProcessPool("gone"), KeyboardInterrupt()], ids=repr)
def test_what_was_measured_is_printed_whatever_comes(monkeypatch, capsys, end):
    answers = iter([("cpu", 1), IT, end, IT])

    def in_new_process(function, *arguments):
        answer = next(answers)
        if isinstance(answer, BaseException):
            raise answer
        return answer

    monkeypatch.setattr(scaling, "in_new_process", in_new_process)
    is_interrupt = isinstance(end, KeyboardInterrupt)
    with pytest.raises(KeyboardInterrupt) if is_interrupt else contextlib.nullcontext():
        scaling.main(sizes=(128, 32, 512), physics=("c",))
    lines = [line.split("|")[3:5] for line in capsys.readouterr().out.splitlines() if line.startswith("|")]
    # After the batch that was too large no larger one is tried.
    rows = [["32", "64"]] if is_interrupt else [["32", "64"], ["128", "killed"]]
    assert [[cell.strip() for cell in line] for line in lines[2:]] == rows


def test_the_rollouts_of_a_case_are_compiled_and_run():
    compiled, run = scaling._compile(Case("mjx", 1, 3, 0.1), scaling._no_physics)
    outcomes, is_failed = run()
    assert outcomes.reward.shape == (3,) and not is_failed.any()
    assert compiled.memory_analysis().output_size_in_bytes > 0


def test_the_largest_memory_is_in_mebibytes():
    # A process with jax; bytes or KiB would be far off.
    assert 50 < scaling.peak_memory() < 50_000
