import types

import numpy as np
import pytest

from creps_jax.errors import UserError
from creps_jax.tools.video import Clip, VideoError, _tilt, layout, write_video

BOX = """
<mujoco>
  <worldbody>
    <light pos="0 0 3"/>
    <geom type="plane" size="0 0 0.1" rgba="0.4 0.6 0.4 1"/>
    <body pos="0 0 0.3"><freejoint/><geom type="box" size="0.1 0.1 0.3"/></body>
  </worldbody>
</mujoco>
"""


def make_clip(caption="asked 0.30 m/s, reached 0.31 m/s", steps=10):
    qpos = np.tile(np.array([0, 0, 0.3, 1, 0, 0, 0], float), (steps, 1))
    qpos[:, 0] = np.linspace(0, 0.2, steps)
    return Clip(caption, qpos, 0.02)


@pytest.fixture
def model(tmp_path):
    path = tmp_path / "box.xml"
    path.write_text(BOX)
    return path


def test_a_floor_that_rises_ahead_is_drawn_so():
    turned = {"geom_xpos": np.array([[1.0, 2.0, 0.0]]), "geom_xmat": np.eye(3).reshape(1, 9)}
    rotation = _tilt(types.SimpleNamespace(**turned), 30.0)
    np.testing.assert_allclose(turned["geom_xpos"], [[np.cos(np.pi / 6), 2.0, 0.5]])
    np.testing.assert_allclose(turned["geom_xmat"].reshape(3, 3), rotation)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)


def test_a_video_and_a_still_are_written_where_there_is_opengl(tmp_path, model):
    path = tmp_path / "new" / "walk.mp4"
    try:
        clips = [make_clip(), make_clip("shorter", 4), make_clip()._replace(slope=5.0)]
        write_video(path, model, clips, still_at=0.1)
    except VideoError as error:
        pytest.skip(str(error))
    assert path.read_bytes()[4:8] == b"ftyp"
    assert path.with_suffix(".png").read_bytes().startswith(b"\x89PNG")
    assert sorted(file.name for file in path.parent.iterdir()) == ["walk.mp4", "walk.png"]


def test_without_opengl_the_error_names_the_libraries(tmp_path, model, monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "none-such")
    with pytest.raises(VideoError, match=r"apt-get install .*libegl1") as caught:
        write_video(tmp_path / "walk.mp4", model, [make_clip()])
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "walk.mp4").exists()


def test_a_video_of_nothing_is_refused(tmp_path, model):
    with pytest.raises(UserError, match="at least one"):
        write_video(tmp_path / "walk.mp4", model, [])


@pytest.mark.parametrize(
    ("count", "cells"), [(1, (1, 1)), (2, (2, 1)), (3, (3, 1)), (4, (2, 2)), (6, (3, 2)), (7, (3, 3))]
)
def test_layout_has_room_for_all(count, cells):
    assert layout(count) == cells
