"""Colours that colour-blind readers tell apart: simulated, and measured."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest

from ppdf_dask.maps import PALETTE
from ppdf_dask.plot import _OTHER, CLASSES
from ppdf_dask.widget import OPACITY, STATES

# Machado, Oliveira, Fernandes (2009), full severity, on linear sRGB.
VISIONS = {
    "normal": np.eye(3),
    "protan": [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]],
    "deutan": [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]],
    "tritan": [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [0.004733, 0.691367, 0.303900]],
}
XYZ = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
WHITE = np.array([0.9505, 1.0, 1.089])
SEEN = 2.3
"""CIE76 difference that is just noticed side by side (Mahy, Van Eycken, Oosterlinck 1994)."""


def seen(colour: str, vision: str, opacity: float) -> np.ndarray:
    """Return the CIE L*a*b* of a colour over white paper, as somebody sees it."""
    srgb = opacity * np.array([int(colour[k : k + 2], 16) for k in (1, 3, 5)]) / 255 + 1 - opacity
    linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    xyz = XYZ @ np.clip(np.array(VISIONS[vision]) @ linear, 0, 1) / WHITE
    f = np.where(xyz > 0.008856, np.cbrt(xyz), 7.787 * xyz + 16 / 116)
    return np.array([116 * f[1] - 16, 500 * (f[0] - f[1]), 200 * (f[1] - f[2])])


@pytest.mark.parametrize("vision", VISIONS)
@pytest.mark.parametrize(
    ("colours", "opacity"),
    [([PALETTE[c] for c in STATES.values()], OPACITY), ([c for _, c in (*CLASSES.values(), _OTHER)], 1.0)],
    ids=["states of the live map", "classes of a section"],
)
def test_no_two_colours_look_alike(colours, opacity, vision):
    labs = [seen(colour, vision, opacity) for colour in colours]
    closest = min(float(np.linalg.norm(a - b)) for a, b in combinations(labs, 2))
    # Four times what is just noticed: the colours lie apart from each other, as small squares and dots.
    assert closest > 4 * SEEN
