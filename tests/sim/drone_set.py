"""A small set of cameras that see a drone, written as the recorded one is; its truth is in closed form."""

from __future__ import annotations

import json
import lzma
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sim.recordings.drone_cameras import CLOCKS
from sim.recordings.lens import Lens
from sim.recordings.resection import CameraPose
from tests.sim.test_resection import PLACES, flown, looking

Array = NDArray[np.float64]

RATE_HZ = 59.94006
SHIFT_S = 12.26
"""The track's first row is so long before frame 0 of camera 0."""
ROWS = 300
HIDDEN_S = (30.0, 33.0)
"""Nobody sees the drone between these instants of the track."""


@dataclass(frozen=True, slots=True)
class Built:
    """A camera of the set: its number, model, frame rate, lens and pose."""

    number: int
    model: str
    fps: float
    lens: Lens
    pose: CameraPose

    def t_s(self, frame: Array) -> Array:
        """Time of the track at frames."""
        alpha, beta = CLOCKS[self.number]
        return np.asarray((alpha * frame + beta) / RATE_HZ + SHIFT_S)


BUILT = (
    Built(0, "wide", 59.94006, Lens((874.0, 894.0), (970.0, 531.0), (1920.0, 1080.0), (-0.2, 0.05, 0.0, 0.0, 0.0)),
          looking(PLACES[0])),
    Built(3, "flat", 25.0, Lens((1177.0, 1573.0), (703.0, 532.0), (1440.0, 1080.0), (-0.1, 0.14, -1e-4, -4e-4, -0.07)),
          looking(PLACES[1])),
    Built(5, "long", 50.0, Lens((1506.0, 1505.0), (967.0, 530.0), (1920.0, 1080.0), (-0.007, 0.008, 0.0, 0.0, 0.0)),
          looking(PLACES[2])),
)  # fmt: skip
MODELS = ("wide", "phone", "other", "flat", "small", "long")


def track() -> Array:
    return flown(np.arange(ROWS) / 5.0)


def write(place: Path, packed: bool = False, sigma_px: float = 0.3) -> Path:
    """Writes the set beneath `place` and returns the folder to load; the cameras 1, 2 and 4 saw nothing."""
    folder = place / "part"
    (folder / "detections").mkdir(parents=True)
    (place / "calibration").mkdir()
    (folder / "cameras.txt").write_text("".join(f"cam{n} - {model}\n" for n, model in enumerate(MODELS)) + "\n")
    rtk = "# made by hand\n" + "".join(f"{x!r} {y!r} {z!r}\n" for x, y, z in track().tolist())
    _put(folder / "rtk.txt", rtk, packed)
    for camera in BUILT:
        _put(folder / "detections" / f"cam{camera.number}.txt", detections(camera, sigma_px), packed)
        (fx, fy), (cx, cy) = camera.lens.focal_px, camera.lens.center_px
        data = {
            "K-matrix": [[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]],
            "distCoeff": list(camera.lens.distortion),
            "fps": camera.fps,
            "resolution": [int(item) for item in camera.lens.size_px],
        }
        name = f"{camera.model}_1.json" if camera.model == "flat" else f"{camera.model}.json"
        (place / "calibration" / name).write_text(json.dumps(data))
    return folder


def detections(camera: Built, sigma_px: float) -> str:
    """Lines `frame x y`; 0 0 where the drone is hidden or out of the image."""
    alpha, beta = CLOCKS[camera.number]
    frame = np.arange(1.0, ((ROWS / 5.0 + 2.0 - SHIFT_S) * RATE_HZ - beta) / alpha)
    t_s = camera.t_s(frame)
    pixel = camera.lens.distorted(camera.pose.project(flown(t_s)))
    pixel += sigma_px * np.random.default_rng(camera.number).standard_normal(pixel.shape)
    shown = np.all((pixel > 0.0) & (pixel < camera.lens.size_px), axis=1)
    shown &= (t_s >= 0.0) & (t_s <= (ROWS - 1) / 5.0) & ~((t_s > HIDDEN_S[0]) & (t_s < HIDDEN_S[1]))
    pixel[~shown] = 0.0
    rows = zip(frame.tolist(), pixel.tolist())
    return " frame no.            x            y\n" + "".join(f"{n:f} {x:.8f} {y:.8f}\n" for n, (x, y) in rows)


def _put(path: Path, text: str, packed: bool) -> None:
    if packed:
        path.with_name(f"{path.name}.xz").write_bytes(lzma.compress(text.encode()))
    else:
        path.write_text(text)
