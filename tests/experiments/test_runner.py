import dataclasses
import json
import sys
from pathlib import Path

import numpy as np
import pytest

from creps_jax import files
from creps_jax.errors import UserError
from creps_jax.policies.feature_settings import Features
from creps_jax.tools import folder_lock, results
from experiments import claims, cli, learning, registry, runner, walk
from experiments.cli import main
from experiments.request import Request, default_settings, folder_to_resume


def run(said=None, changes=None, **request):
    begin = {name: value for name, value in request.items() if name != "seed"}
    settings = default_settings(registry.load("tiny"), "tiny", **begin)
    settings = dataclasses.replace(settings, **(changes or {}))
    said = [] if said is None else said
    return runner.run(Request("tiny", settings, **request), console=None, say=said.append)


def interrupt_after(monkeypatch, iterations: int, error: BaseException) -> None:
    """Let learning fail once so many iterations are done."""
    take = learning._Keeper.take

    def take_then_fail(keeper, state, log):
        take(keeper, state, log)
        if len(keeper.latest.log["mean_reward"]) == iterations:
            raise error

    monkeypatch.setattr(learning._Keeper, "take", take_then_fail)


def test_a_run_leaves_arrays_manifest_figure_and_claims(tiny):
    folder = run(seed=3)
    assert folder.parent == Path("results/tiny")
    names = {path.name for path in folder.iterdir()}
    assert names == {"arrays.npz", "manifest.json", "curve.png", "claims.md", "checkpoint-tiny.npz"}
    arrays = files.load_arrays(folder / "arrays.npz")
    assert arrays["reward"].shape == (2, 4)
    assert arrays["coef"].shape == (2, 4, 2, 1)
    manifest = results.load_manifest(folder)
    assert (manifest["status"], manifest["seed"], manifest["preset"]) == ("finished", 3, "quick")
    assert manifest["seconds"] > 0
    assert results.latest_folder("tiny", status="finished") == folder


def test_changed_settings_are_kept(tiny):
    folder = run(changes={"iterations": 2, "trials": 2}, out=Path("here"))
    assert files.load_arrays(folder / "arrays.npz")["reward"].shape == (2, 2)
    assert results.load_manifest(folder)["settings"]["iterations"] == 2


@pytest.mark.parametrize("error", [KeyboardInterrupt(), UserError("disk full"), RuntimeError("bug")])
def test_a_run_that_stopped_goes_on_with_the_same_numbers(tiny, monkeypatch, error):
    whole = files.load_arrays(run() / "arrays.npz")
    said = []
    with monkeypatch.context() as patch, pytest.raises(type(error)):
        interrupt_after(patch, 2, error)
        run(said, out=Path("part"))
    status = results.load_manifest(Path("part"))["status"]
    assert status == ("interrupted" if isinstance(error, KeyboardInterrupt) else "failed")
    assert not isinstance(error, KeyboardInterrupt) or "--resume --out part" in said[-1]
    resumed = files.load_arrays(run(out=Path("part"), resume=True) / "arrays.npz")
    for name, values in whole.items():
        np.testing.assert_array_equal(resumed[name], values)
    assert results.load_manifest(Path("part"))["status"] == "finished"


def test_settings_that_are_refused_leave_no_run_behind(tiny, monkeypatch):
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        interrupt_after(patch, 2, KeyboardInterrupt())
        run()
    unfinished = folder_to_resume("tiny", None)

    def refuse(settings, key, session):
        raise ValueError("kl_bound must be above 0")

    monkeypatch.setattr(tiny, "run", refuse)
    for out in (None, Path("named")):
        with pytest.raises(ValueError, match="kl_bound"):
            run(out=out)
    assert folder_to_resume("tiny", None) == unfinished
    assert not Path("named").exists()


def test_a_run_that_is_running_is_not_joined(tiny):
    folder = run(out=Path("here"))
    with folder_lock.locked(folder, wait=0.0), pytest.raises(UserError, match="here is in use by another"):
        run(out=folder, resume=True)
    run(out=folder, resume=True)


def test_where_folders_cannot_be_locked_a_run_goes_on(tiny, monkeypatch):
    def refuse(*_, **__):
        raise OSError("no locks here")

    monkeypatch.setattr(folder_lock.filelock.FileLock, "acquire", refuse)
    assert results.load_manifest(run())["status"] == "finished"


def test_resume_finds_the_latest_unfinished_run_and_can_lengthen_it(tiny, monkeypatch):
    run()
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        interrupt_after(patch, 1, KeyboardInterrupt())
        run()
    folder = run(resume=True, changes={"iterations": 6})
    longer = files.load_arrays(folder / "arrays.npz")
    assert longer["reward"].shape == (2, 6)
    np.testing.assert_array_equal(
        longer["reward"], files.load_arrays(run(preset="long") / "arrays.npz")["reward"]
    )
    with pytest.raises(UserError, match="no unfinished run"):
        run(resume=True)


def test_a_checkpoint_that_is_cut_short_is_named_and_left_alone(tiny, monkeypatch):
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        interrupt_after(patch, 2, KeyboardInterrupt())
        run(out=Path("part"))
    path = Path("part/checkpoint-tiny.npz")
    path.write_bytes(path.read_bytes()[:-50])
    cut = path.read_bytes()
    with pytest.raises(UserError, match=r"checkpoint-tiny\.npz"):
        run(out=Path("part"), resume=True)
    assert path.read_bytes() == cut


def test_mistakes_in_a_request_are_named_and_change_nothing(tiny):
    folder = run(changes={"iterations": 1}, out=Path("done"))
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    Path("file").write_text("")
    Path("empty").mkdir()
    for match, request in (
        ("unknown preset 'quik', did you mean 'quick'", {"preset": "quik"}),
        ("done holds a run already: add --resume", {"out": Path("done")}),
        ("file is a file", {"out": Path("file")}),
        ("empty is no result folder", {"out": Path("empty"), "resume": True}),
        ("has seed 0, not 5", {"out": Path("done"), "resume": True, "seed": 5}),
        ("trials 2, not 3", {"out": Path("done"), "resume": True, "changes": {"trials": 3}}),
        ("has preset 'quick', not 'long'", {"out": Path("done"), "resume": True, "preset": "long"}),
        ("iterations must be at least 1, got 0", {"changes": {"iterations": 0}}),
        ("trials must be at most 1000, got 1001", {"changes": {"trials": 1001}}),
        ("none.json", {"config": Path("none.json")}),
        ("does not go with --preset", {"config": Path("done/manifest.json"), "preset": "long"}),
    ):
        with pytest.raises(UserError, match=match):
            run(**request)
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before
    assert not Path("results").exists()


def test_settings_of_another_version_are_named(tiny):
    folder = run(changes={"iterations": 1}, out=Path("done"))
    manifest = results.load_manifest(folder)
    (folder / "manifest.json").write_text(json.dumps({**manifest, "settings": {"foo": 1}}))
    with pytest.raises(UserError, match="cannot use the settings of"):
        run(out=folder, resume=True)


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"seed": "x"}, "must have a whole number as seed, got 'x'"),
        ({"seed": -3}, "seed must be from 0 to"),
        (
            {"settings": {"iterations": "5"}},
            "cannot use .* iterations must be a whole number, got '5'",
        ),
        ({"settings": {"speeds": None}}, "cannot use .* speeds must be a list, got None"),
        ({"experiment": "walk"}, r"manifest\.json is of 'walk', expected 'tiny'"),
    ],
)
def test_a_manifest_that_no_run_has_written_is_refused(tiny, changes, match):
    folder = run(changes={"iterations": 1}, out=Path("done"))
    path = folder / "manifest.json"
    path.write_text(json.dumps({**results.load_manifest(folder), **changes}))
    with pytest.raises(UserError, match=match):
        run(config=path, out=Path("new"))
    assert not Path("new").exists()


@pytest.mark.parametrize(
    ("out", "reason"),
    [
        ("/proc/foo", "cannot write to the folder /proc/foo: No such file or directory"),
        ("/proc", "/proc holds other files, such as"),
        ("file/below", "cannot write to the folder file/below: Not a directory"),
        ("file", "file is a file, expected a folder"),
        ("/dev/full", "/dev/full is a file, expected a folder"),
        ("long" * 100, "File name too long"),
    ],
)
def test_a_bad_place_for_results_is_one_sentence(tiny, capsys, out, reason):
    Path("file").write_text("")
    assert main(["run", "tiny", "--out", out]) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ") and reason in error and out in error and len(error.splitlines()) == 1
    assert "Errno" not in error


def test_a_place_that_becomes_bad_is_one_sentence(tiny, capsys, monkeypatch):
    def refuse(*_, **__):
        raise PermissionError(13, "Permission denied", "here")

    monkeypatch.setattr(Path, "mkdir", refuse)
    assert main(["run", "tiny", "--out", "here"]) == 2
    assert capsys.readouterr().err == "error: cannot use here: Permission denied\n"


def test_changed_settings_are_named_beside_the_claims(tiny, capsys):
    folder = run(out=Path("results/tiny/one"))
    assert main(["check", "tiny"]) == 0
    assert "\nsettings: preset quick\n" in capsys.readouterr().out
    run(out=Path("results/tiny/two"), changes={"iterations": 2, "speeds": (0.3,)})
    assert main(["check", "tiny"]) == 0
    note = (
        "settings: preset quick, but iterations 2 (preset: 4), speeds (0.3,) (preset: (0.1, 0.2)); "
        "the claims are judged all the same"
    )
    assert note in capsys.readouterr().out.splitlines()
    assert note in Path("results/tiny/two/claims.md").read_text()
    run(out=Path("results/tiny/three"), config=folder / "manifest.json")
    assert main(["check", "tiny"]) == 0
    assert "settings: not from a preset, but from config; the claims" in capsys.readouterr().out
    manifest = results.load_manifest(folder)
    assert "of another version" in claims.settings_note(tiny, {**manifest, "settings": {"foo": 1}})


def test_settings_that_the_machine_decides_do_not_differ_from_a_preset():
    for physics in ("c", "mjx"):
        settings = dataclasses.replace(walk.SETTINGS["best"].resolved(), physics=physics)
        manifest = results.make_manifest("walk", "best", settings, 0)
        assert claims.settings_note(registry.load("walk"), manifest) == "settings: preset best"
    settings = dataclasses.replace(settings, features=Features("rbf", 7), high=0.5)
    note = claims.settings_note(registry.load("walk"), results.make_manifest("walk", "best", settings, 0))
    assert "preset best, but features.num_centers 7 (preset: 5), high 0.5 (preset: 0.6); the" in note


@pytest.mark.parametrize("name", registry.EXPERIMENTS)
def test_presets_are_listed_as_the_modules_have_them(name):
    assert registry.EXPERIMENTS[name].presets == tuple(registry.load(name).SETTINGS)


def test_plot_and_check_use_the_latest_results(tiny, capsys):
    assert main(["plot", "tiny"]) == 2
    folder = run(changes={"iterations": 1})
    (folder / "curve.png").unlink()
    assert main(["plot", "tiny"]) == 0
    assert (folder / "curve.png").exists()
    assert main(["check", "tiny"]) == 0
    tiny.CLAIMS = (registry.Claim("last reward", lambda arrays: arrays["reward"].mean(), low=1e3),)
    assert main(["check", "tiny"]) == 1
    assert "| NO |" in " ".join(capsys.readouterr().out.split())


def test_the_command_runs_resumes_and_reports_mistakes(tiny, capsys, monkeypatch):
    with monkeypatch.context() as patch:
        interrupt_after(patch, 1, KeyboardInterrupt())
        assert main(["run", "tiny", "--out", "part", "--seed", "1"]) == 130
    assert main(["run", "tiny", "--resume", "--out", "part"]) == 0
    assert "iteration 4/4" in capsys.readouterr().out
    assert main(["run", "tiny", "--out", "part"]) == 2
    assert capsys.readouterr().err.startswith("error: part holds a run already")


def test_every_setting_is_an_option_and_a_manifest_runs_a_run_again(tiny, capsys):
    options = ["--preset", "long", "--trials", "1", "--speeds", "0.3", "0.4", "--seed", "7"]
    assert main(["run", "tiny", *options, "--out", "first"]) == 0
    first = results.load_manifest(Path("first"))
    assert first["settings"] == {"iterations": 6, "trials": 1, "speeds": [0.3, 0.4]}
    assert main(["run", "tiny", "--config", "first/manifest.json", "--out", "again"]) == 0
    again = results.load_manifest(Path("again"))
    assert (again["settings"], again["seed"], again["preset"]) == (first["settings"], 7, "config")
    one, other = (files.load_arrays(Path(name) / "arrays.npz") for name in ("first", "again"))
    np.testing.assert_array_equal(one["reward"], other["reward"])
    capsys.readouterr()
    assert main(["run", "tiny", "--trails", "1"]) == 2
    assert "unknown option --trails, did you mean --trials?" in capsys.readouterr().err


def test_all_runs_every_figure_in_a_folder_of_its_own(tiny, monkeypatch):
    monkeypatch.setattr(registry, "FIGURES", ("tiny", "tiny"))
    assert main(["run", "all", "--iterations", "2"]) == 0
    assert len(list(Path("results/tiny").iterdir())) == 2
    monkeypatch.setattr(registry, "FIGURES", ("tiny",))
    assert main(["run", "all", "--iterations", "2", "--out", "here"]) == 0
    assert (Path("here") / "tiny" / "arrays.npz").exists()
    assert main(["run", "all", "--resume"]) == 2


def test_processes_that_share_a_run_of_all_figures_join_once(tiny, monkeypatch, capsys):
    joined = []
    monkeypatch.setattr(registry, "FIGURES", ("tiny", "same"))
    monkeypatch.setitem(registry.EXPERIMENTS, "same", registry.EXPERIMENTS["tiny"])
    monkeypatch.setitem(sys.modules, "experiments.same", sys.modules["experiments.tiny"])
    monkeypatch.setattr(cli, "join_processes", lambda: joined.append(1))
    assert main(["run", "all", "--distributed", "--iterations", "2"]) == 2
    assert "processes that share a run need --out" in capsys.readouterr().err and not joined
    assert main(["run", "all", "--distributed", "--iterations", "2", "--out", "here"]) == 0
    assert joined == [1]
    assert {path.parent.name for path in Path("here").glob("*/arrays.npz")} == {"tiny", "same"}
