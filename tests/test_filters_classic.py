"""What all classic filters promise: any cloud, any order, any place; core points only; agreement with the peers."""

from __future__ import annotations

import dataclasses
import os
import re
from pathlib import Path

import laspy
import numpy as np
import pytest
from classic_clouds import cloud_of, nasty, points
from hypothesis import given, settings

from ppdf_dask import filters
from ppdf_dask.errors import ParameterError
from ppdf_dask.filters import msf, pmf, ptdf, smrf
from ppdf_dask.filters.cloud import Cloud, cloud_from_xyz

CLASSIC = {
    f"{module.FILTER.name} {profile}": (module.FILTER, params)
    for module in (msf, pmf, ptdf, smrf)
    for profile, params in module.FILTER.profiles.items()
}
each = pytest.mark.parametrize("name", CLASSIC)


@each
@pytest.mark.parametrize("kind", nasty())
def test_nasty_clouds(name, kind):
    chosen, params = CLASSIC[name]
    cloud = cloud_of(nasty()[kind])
    verdict = chosen.classify(cloud, params)
    assert verdict.ground.shape == verdict.unproven.shape == (cloud.n,)
    assert verdict.ground.dtype == verdict.unproven.dtype == bool
    assert not verdict.unproven.any()
    if kind in ("empty", "one", "two", "identical", "two places"):
        assert not verdict.ground.any()
    if kind == "stray point 2000 km away":
        alone = chosen.classify(cloud_of(nasty()[kind][:-1]), params)
        assert verdict.ground.tolist() == [*alone.ground.tolist(), False]
    if kind in ("grid", "line along x"):
        assert verdict.ground.all()


@each
@given(pts=points())
@settings(deadline=None, max_examples=20)
def test_order_place_and_duplicates(name, pts):
    chosen, params = CLASSIC[name]
    params = params.replace(window=4.0)
    ground = chosen.classify(cloud_of(pts), params).ground
    labels = dict(zip(pts, ground.tolist(), strict=True))
    assert [labels[p] for p in pts] == ground.tolist()
    order = np.random.default_rng(len(pts)).permutation(len(pts))
    shuffled = [pts[k] for k in order]
    assert chosen.classify(cloud_of(shuffled), params).ground.tolist() == [labels[p] for p in shuffled]
    # By whole cells, windows and blocks of islands; up only where no mean of heights is rounded.
    up = 4321 if chosen.name in ("msf", "ptdf") else 0
    moved = [(x + 1_000_000, y - 3_000_000, z + up) for x, y, z in pts]
    assert chosen.classify(cloud_of(moved), params).ground.tolist() == ground.tolist()


@each
@given(pts=points())
@settings(deadline=None, max_examples=15)
def test_surroundings_count_but_only_the_core_is_classified(name, pts):
    chosen, params = CLASSIC[name]
    params = params.replace(window=4.0)
    whole = cloud_of(pts)
    n_core = len(pts) // 3
    part = Cloud(whole.x, whole.y, whole.z, whole.origin, n_core)
    expected = chosen.classify(whole, params).ground[:n_core]
    assert chosen.classify(part, params).ground.tolist() == expected.tolist()


@pytest.mark.parametrize("name", ["csf", "msf", "pcom", "pmf", "ppdf", "ptdf", "smrf", "voxel"])
def test_wrong_values_are_refused_with_their_unit(name):
    checked = 0
    for params in filters.get(name).profiles.values():
        for field in dataclasses.fields(params):
            unit, low, high = (field.metadata.get(k) for k in ("unit", "low", "high"))
            if unit is None:
                continue
            for bound, wrong, side in ((low, -1, "below"), (high, 1, "above")):
                if bound is not None:
                    with pytest.raises(ParameterError, match=rf"{field.name} = .* {re.escape(unit)} is {side} the"):
                        params.replace(**{field.name: bound + wrong})
                    checked += 1
            with pytest.raises(ParameterError, match=f"{field.name} = 'x' is not a finite number of {re.escape(unit)}"):
                params.replace(**{field.name: "x"})
    assert checked >= 4


@pytest.mark.parametrize("name", ["msf", "pmf", "csf", "ptdf", "smrf"])
def test_registered(name):
    found = filters.get(name)
    assert found.name == name
    assert not found.exact
    default = filters.parameters(name)
    assert filters.of(default) is found
    assert found.required_buffer(default) > 0
    assert type(default).from_dict(default.as_dict()) == default


def load(name):
    """The last and only returns without the noise classes, and what is scored."""
    folder = os.environ.get("PPDF_DASK_DATA")
    if not folder:
        pytest.skip("PPDF_DASK_DATA is not set")
    tile = laspy.read(Path(folder) / "als" / f"{name}.laz")
    mark = np.asarray(tile.user_data)
    seen = (mark != 2) & (np.asarray(tile.return_number) >= np.asarray(tile.number_of_returns))
    return np.asarray(tile.xyz), seen, mark == 0, np.asarray(tile.classification) == 2


# Total error in % of PDAL 2.10 (SMRF, PMF, CSF) and lasR 0.21 (PTD), each at its defaults on last and only returns.
PEERS = {
    "isprs_samp11": (9.92, 17.16, 38.21, 18.48),
    "isprs_samp12": (3.15, 5.91, 7.54, 10.25),
    "isprs_samp31": (3.39, 4.05, 8.10, 10.72),
    "isprs_samp51": (5.60, 6.89, 18.80, 3.02),
    "isprs_samp53": (4.36, 10.91, 39.92, 12.19),
    "isprs_samp61": (1.01, 4.87, 12.42, 2.89),
    "fontblanche_m30": (1.02, 3.32, 1.09, 2.54),
    "ignhd_crop1": (0.06, 10.96, 0.91, 45.25),
    "pdal_utm42_mountain": (4.43, 21.45, 41.34, 4.41),
    "pyfor_test": (6.73, 20.64, 6.97, 13.41),
    "ignhd_dec_0292_6833": (6.16, 6.02, 5.17, 5.63),
    "bcts_1": (16.54, 1.43, 13.62, 5.92),
    "bcts_3": (15.30, 1.83, 14.21, 5.82),
    "lidR_topography": (12.32, 9.58, 9.63, 10.36),
}

# How far ours may be from theirs, in points: on any cloud, and in the mean. Their rasters hang at the cloud's corner,
# ours at absolute cells: the clouds are moved so that both are the same. What remains: of equally near cells they fill
# a gap with any, we with the mean of all; heights on a tolerance to the centimetre (0.15 m in PMF) fall either way in
# floating point, and always out in integers; lasR adds points one by one in the order of their height instead of the
# best of each facet, and removes spikes at the end: 3.9 points apart on the quarry's break lines (samp53).
FARTHEST = {"smrf": (0.2, 0.1), "pmf": (1.3, 0.4), "csf": (0.4, 0.1), "ptdf": (4.0, 0.9)}
PROFILES = {"smrf": "default", "pmf": "pdal", "csf": "default", "ptdf": "lasr"}


def distance_to_the_peer(name, cloud):
    """Total error of ours less theirs, points."""
    if name == "csf":
        pytest.importorskip("CSF", reason="the extra csf is not installed")
    xyz, seen, scored, reference = load(cloud)
    ground = np.zeros(len(xyz), bool)
    found = filters.get(name)
    at_corner = xyz[seen] - xyz[seen].min(axis=0)
    ground[seen] = found.classify(cloud_from_xyz(at_corner), found.profiles[PROFILES[name]]).ground
    total = 100 * np.mean(ground[scored] != reference[scored])
    return total - PEERS[cloud][list(FARTHEST).index(name)]


@pytest.mark.parametrize("cloud", ["isprs_samp12", "isprs_samp31", "pdal_utm42_mountain", "fontblanche_m30"])
@pytest.mark.parametrize("name", ["smrf", "pmf", "ptdf"])
def test_agreement_with_the_peers(name, cloud):
    assert abs(distance_to_the_peer(name, cloud)) <= FARTHEST[name][0]


@pytest.mark.slow
@pytest.mark.parametrize("name", FARTHEST)
def test_agreement_with_the_peers_on_every_cloud(name):
    away = {cloud: distance_to_the_peer(name, cloud) for cloud in PEERS}
    size = np.abs(list(away.values()))
    print(*(f"{name} {cloud} {d:+.2f}" for cloud, d in away.items()), sep="\n")
    print(f"{name}: {size.max():.2f} at most, {size.mean():.2f} in the mean")
    most, mean = FARTHEST[name]
    assert size.max() <= most
    assert size.mean() <= mean
