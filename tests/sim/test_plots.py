"""How pictures are written: small, and in the colours that tables use."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from sim import plots


def rgb(code: str) -> tuple[int, ...]:
    return tuple(int(code[k : k + 2], 16) for k in (1, 3, 5))


def test_a_picture_of_many_shades_is_small_and_keeps_the_robots_colours(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(plots, "DPI", 60)
    rng = np.random.default_rng(1)
    with plots.drawing(tmp_path / "p.png", 4.0) as figure:
        axes = figure.subplots()
        for index in range(len(plots.PALETTE)):
            axes.axhspan(index, index + 0.1, xmax=0.1, color=plots.colour(index), lw=0, zorder=9)
            for x, y in rng.uniform(0.0, 7.0, size=(150, 2)):
                axes.fill_between([x, x + 1.5], y, y + 1.0, color=plots.colour(index), alpha=0.1, lw=0)
    with Image.open(tmp_path / "p.png") as image:
        assert image.mode == "P"
        shades = np.asarray(image.convert("RGB")).reshape(-1, 3)
    assert tuple(shades[0]) == (255, 255, 255)
    for code in plots.PALETTE:
        assert (shades == rgb(code)).all(axis=1).sum() > 20, code
