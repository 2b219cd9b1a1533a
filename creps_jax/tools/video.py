"""Film recorded walks with MuJoCo's renderer, several side by side; this needs OpenGL.

A new process renders: if the graphics driver crashes, the run continues, and the choice of a graphics library
does not affect this process.
"""

import contextlib
import math
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from creps_jax.errors import UserError
from creps_jax.files import load_arrays, save_arrays, write_atomically

FPS = 25
CELL_SIZE = (426, 320)
_LIBRARIES_HINT = "apt-get install -y --no-install-recommends libegl1 libgl1 libgl1-mesa-dri"
_TIME_LIMIT = 600


class Clip(NamedTuple):
    """A recorded walk and its caption.

    Attributes:
        caption: one line of text, or one for each position.
        qpos: (n, nq) generalised positions.
        period: seconds between two of them.
        slope: slope of the floor, deg, positive if it rises ahead; positions are in the frame of the floor.
    """

    caption: str | Sequence[str]
    qpos: np.ndarray
    period: float
    slope: float = 0.0


class VideoError(UserError):
    """A video cannot be made; the message has the reason, and what may help."""


def write_video(
    path: Path, model: Path, clips: Sequence[Clip], *, still_at: float | None = None, size: float = 1.0
) -> None:
    """Film walks side by side, each with a camera that follows the robot.

    Args:
        path: the .mp4 file, written atomically.
        model: the MJCF file of the robot, or its compiled model, an .mjb file.
        clips: the walks; a shorter one stops at its last frame.
        still_at: time in seconds of a frame in better quality, written next to the video as .png; None writes
            none.
        size: length of a leg relative to that of the NAO, which decides on the distance of the camera.

    Raises:
        VideoError: if rendering fails, for example without OpenGL.
        UserError: if the file cannot be written.
    """
    if not clips:
        raise UserError("a video needs at least one walk")
    environment = dict(os.environ)
    if sys.platform == "linux":
        environment.setdefault("MUJOCO_GL", "egl")
    with tempfile.TemporaryDirectory(prefix="creps_jax-") as folder:
        job, video, still = (Path(folder) / name for name in ("job.npz", "video.mp4", "still.png"))
        save_arrays(job, _job(model, clips, -1.0 if still_at is None else still_at) | {"size": size})
        command = [sys.executable, "-m", "creps_jax.tools.video", str(job), str(video), str(still)]
        try:
            done = subprocess.run(
                command,
                cwd=Path(__file__).parents[2],
                env=environment,
                capture_output=True,
                text=True,
                timeout=_TIME_LIMIT,
            )
        except subprocess.TimeoutExpired as error:
            raise VideoError(f"no video: rendering took more than {_TIME_LIMIT} s") from error
        if done.returncode != 0 or not video.exists():
            raise VideoError(_explain(done.returncode, done.stderr))
        write_atomically(path, lambda file: file.write(video.read_bytes()))
        if still_at is not None:
            write_atomically(path.with_suffix(".png"), lambda file: file.write(still.read_bytes()))


def _job(model: Path, clips: Sequence[Clip], still_at: float) -> dict[str, object]:
    arrays: dict[str, object] = {"model": str(model.resolve()), "still_at": still_at}
    for index, clip in enumerate(clips):
        arrays[f"caption{index}"] = np.array(clip.caption)
    arrays["periods"] = np.array([clip.period for clip in clips])
    arrays["slopes"] = np.array([clip.slope for clip in clips])
    return arrays | {f"qpos{index}": np.asarray(clip.qpos) for index, clip in enumerate(clips)}


def _explain(code: int, output: str) -> str:
    lines = [line.strip() for line in output.splitlines() if line.strip()]
    last = lines[-1] if lines else f"the renderer ended with code {code}"
    if "imageio_ffmpeg" in last or "No space left" in last:
        return f"no video: {last}"
    return f"no video: there is no OpenGL ({last}); on Debian or Ubuntu: {_LIBRARIES_HINT}"


def _render_job(job: Path, video: Path, still: Path) -> None:
    """Render in the child process."""
    import imageio_ffmpeg
    import mujoco
    from PIL import Image

    arrays = load_arrays(job)
    clips = [
        Clip(
            arrays[f"caption{index}"].tolist(),
            arrays[f"qpos{index}"].astype(float),
            float(period),
            float(slope),
        )
        for index, (period, slope) in enumerate(zip(arrays["periods"], arrays["slopes"], strict=True))
    ]
    columns, rows = layout(len(clips))
    is_compiled = str(arrays["model"]).endswith(".mjb")
    load = mujoco.MjModel.from_binary_path if is_compiled else mujoco.MjModel.from_xml_path
    model, scale = load(str(arrays["model"])), float(arrays["size"])
    size = (columns * CELL_SIZE[0], rows * CELL_SIZE[1])
    writer = imageio_ffmpeg.write_frames(
        str(video), size, fps=FPS, codec="libx264", quality=None, macro_block_size=2,
        output_params=["-crf", "23", "-preset", "veryfast", "-movflags", "+faststart"],
    )  # fmt: skip
    writer.send(None)
    with contextlib.closing(writer):
        for frame in _frames(model, clips, scale=1, robot_size=scale):
            writer.send(np.ascontiguousarray(frame))
    still_at = float(arrays["still_at"])
    if still_at >= 0:
        (frame,) = _frames(model, clips, scale=2, robot_size=scale, fine=True, at=still_at)
        Image.fromarray(frame).save(still, optimize=True)


def _frames(
    model,
    clips: Sequence[Clip],
    *,
    scale: int,
    robot_size: float,
    fine: bool = False,
    at: float | None = None,
) -> Iterator[np.ndarray]:
    """Yield the frames of a video, or the frame at a time: a grid of cells, one for each clip.

    Args:
        model: the compiled robot.
        clips: the walks.
        scale: size of a cell, as a factor of CELL_SIZE.
        robot_size: size of the robot relative to the NAO.
        fine: whether to draw shadows and smooth edges; otherwise cells are drawn at twice their size
            and averaged, which is three times as fast without a graphics card.
        at: time of the only frame, s; None is all frames.
    """
    import mujoco
    from PIL import Image

    columns, rows = layout(len(clips))
    width, height = CELL_SIZE[0] * scale, CELL_SIZE[1] * scale
    factor = 1 if fine else 2
    model.vis.global_.offwidth, model.vis.global_.offheight = width * factor, height * factor
    model.vis.quality.offsamples = 4 if fine else 0
    data = mujoco.MjData(model)
    camera = mujoco.MjvCamera()
    camera.azimuth, camera.elevation, camera.distance = 125.0, -12.0, 1.1 * robot_size
    seconds = max(len(clip.qpos) * clip.period for clip in clips)
    times = [at] if at is not None else np.arange(max(1, math.floor(seconds * FPS))) / FPS
    paths = [_smooth(clip.qpos[:, :2], round(0.6 / clip.period)) for clip in clips]
    with mujoco.Renderer(model, height * factor, width * factor) as renderer:
        renderer.scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = fine
        renderer.scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = False
        for time in times:
            frame = np.full((rows * height, columns * width, 3), 255, np.uint8)
            for cell, (clip, path) in enumerate(zip(clips, paths, strict=True)):
                index = min(round(time / clip.period), len(clip.qpos) - 1)
                data.qpos[:] = clip.qpos[index]
                mujoco.mj_kinematics(model, data)
                mujoco.mj_camlight(model, data)
                camera.lookat[:] = _tilt(data, clip.slope) @ (*path[index], 0.26 * robot_size)
                renderer.update_scene(data, camera)
                image = Image.fromarray(renderer.render()).reduce(factor)
                row, column = divmod(cell, columns)
                frame[row * height : (row + 1) * height, column * width : (column + 1) * width] = _captioned(
                    image, _caption_at(clip, index), index * clip.period, scale
                )
            yield frame


def _caption_at(clip: Clip, index: int) -> str:
    return clip.caption if isinstance(clip.caption, str) else clip.caption[index]


def _tilt(data, slope: float) -> np.ndarray:
    """Rotate all geoms from the frame of the floor to the vertical, and return the rotation."""
    angle = math.radians(slope)
    rotation = np.array(
        [[math.cos(angle), 0.0, -math.sin(angle)], [0.0, 1.0, 0.0], [math.sin(angle), 0.0, math.cos(angle)]]
    )
    data.geom_xpos[:] = data.geom_xpos @ rotation.T
    data.geom_xmat[:] = (rotation @ data.geom_xmat.reshape(-1, 3, 3)).reshape(-1, 9)
    return rotation


def _captioned(image, caption: str, seconds: float, scale: int) -> np.ndarray:
    """Write a caption on a dark bar along the lower edge of a picture."""
    from PIL import ImageDraw, ImageFont

    draw = ImageDraw.Draw(image, "RGBA")
    top = image.height - 26 * scale
    draw.rectangle((0, top, image.width, image.height), fill=(20, 24, 28, 190))
    font = ImageFont.load_default(size=15 * scale)
    draw.text((8 * scale, top + 4 * scale), caption, font=font, fill=(255, 255, 255, 255))
    clock = f"{seconds:.1f} s"
    draw.text((image.width - 52 * scale, top + 4 * scale), clock, font=font, fill=(200, 205, 210, 255))
    return np.asarray(image)


def _smooth(path: np.ndarray, window: int) -> np.ndarray:
    """Average a path over a window, so that the camera does not sway with each step."""
    window = max(1, min(window, len(path)))
    padded = np.concatenate(
        [
            np.repeat(path[:1], window // 2, axis=0),
            path,
            np.repeat(path[-1:], window - 1 - window // 2, axis=0),
        ]
    )
    sums = np.cumsum(np.concatenate([np.zeros((1, path.shape[1])), padded]), axis=0)
    return (sums[window:] - sums[:-window]) / window


def layout(count: int) -> tuple[int, int]:
    """Return columns and rows of a grid of cells, wider than high."""
    columns = min(3, count) if count != 4 else 2
    return columns, math.ceil(count / columns)


if __name__ == "__main__":
    _render_job(*(Path(argument) for argument in sys.argv[1:4]))
