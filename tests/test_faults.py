"""The table of faults: each case, what is expected, and the tests that hold it; walk through it from the top.

The cases are those of the issue "nothing is lost" (F1 to F59). A case without a test says why.
"""

from __future__ import annotations

import ast
import importlib.util
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from faulty import Inline
from fuzz_reader import check, regressions
from lasfiles import no_more_than, points, write

from ppdf_dask import classify_ground
from ppdf_dask.errors import ParameterError
from ppdf_dask.filters.pmf import PmfParams
from ppdf_dask.params import RunParams
from ppdf_dask.plan import plan
from ppdf_dask.survey import scan

HERE = Path(__file__).parent
LATER = "not applicable yet: "

TABLE: dict[str, tuple[str, list[str] | str]] = {
    "F1": ("empty, not LAS, web page, archive", ["survey::f1_to_f8_broken_headers"]),
    "F2": (
        "truncated header, records, body, chunk table",
        ["survey::f1_to_f8_broken_headers", "reader::f2_f3_cut_bodies"],
    ),
    "F3": (
        "cut on a record boundary, wrong counts",
        [
            "reader::f2_f3_cut_bodies",
            "reader::f3_layered_laz_with_a_wrong_count",
            "reader::f3_old_laz_with_a_larger_count",
        ],
    ),
    "F4": (
        "header claims the impossible",
        ["survey::f1_to_f8_broken_headers", "faults::f4_f56_regressions_of_the_fuzzer"],
    ),
    "F5": (
        "flipped bits in a body",
        [
            "reader::f5_flipped_bytes_end_in_points_or_a_tile_error",
            "faults_damage::f5_a_broken_tile_leaves_its_place_unknown_and_the_rest_is_done",
            "faults_damage::a_file_that_is_left_out_leaves_its_place_unknown_too",
            "checksums::f5_another_byte_is_found_and_the_rest_is_done",
        ],
    ),
    "F6": (
        "no, one, two, collinear, identical points",
        ["formats::f6_few_points_and_none", "formats::f6_f10_collinear_and_equal_points", "reader::f6_few_points"],
    ),
    "F7": (
        "header bounds lie",
        ["survey::f7_impossible_bounds_are_measured", "formats::f7_f16_what_a_header_says_wrong_changes_nothing"],
    ),
    "F8": (
        "impossible or extreme scales and offsets",
        ["survey::f1_to_f8_broken_headers", "reader::grid_axis_is_exact"],
    ),
    "F9": (
        "NaN in arrays, a far outlier",
        [
            "faults::f9_arrays_with_nan_are_refused",
            "faults::f9_a_far_outlier",
            "degenerate::a_stray_point_10_000_km_away_is_refused_by_name",
        ],
    ),
    "F10": (
        "duplicate points",
        [
            "faults::f10_duplicates_keep_their_classes",
            "formats::f6_f10_collinear_and_equal_points",
            "repeats::f10_repeats_are_counted",
            "repeats::f10_f11_a_run_counts_them_and_names_the_tiles",
        ],
    ),
    "F11": (
        "the same tile twice, overlaps",
        [
            "survey::f11_named_twice",
            "survey::f11_copies_and_links",
            "survey::f11_a_millimetre_is_tolerated",
            "repeats::f11_tiles_with_common_points_are_refused_by_name",
            "repeats::f11_flight_lines_over_one_another_are_no_duplicates",
        ],
    ),
    "F12": (
        "mixed, missing, equivalent, geographic CRS",
        [
            "survey::f12_one_crs_in_many_spellings",
            "survey::f12_a_true_mix_is_refused_by_name",
            "survey::f12_missing_in_some",
            "survey::f12_degrees",
        ],
    ),
    "F13": ("feet", ["reader::f13_foot_copy_equals_metre_copy_where_it_is_exact", "survey::f13_units"]),
    "F14": ("all point formats and versions", ["formats::f14_f15_all_but_the_class_stays", "formats::las_1_0_and_1_1"]),
    "F15": (
        "waveforms, EVLRs, unknown records",
        [
            "formats::f14_f15_all_but_the_class_stays",
            "formats::f15_header_and_records_stay_to_the_byte",
            "formats::f15_waveforms_inside_the_file_stay_where_the_header_says",
            "formats::f15_waveforms_compressed_by_laszip_come_out_whole",
            "formats::a_writer_that_loses_bytes_is_caught",
        ],
    ),
    "F16": (
        "WKT bit unset, stray bytes",
        # Expected was "output fixed"; a copy that is the same to the byte was asked for as well, and won.
        [
            "survey::f16_wkt_bit_unset",
            "survey::stray_bytes_and_old_counts_are_only_noted",
            "formats::f7_f16_what_a_header_says_wrong_changes_nothing",
        ],
    ),
    "F17": ("return numbers of zero", ["classes::f17_return_numbers", "classes::f17_odd_return_numbers_are_counted"]),
    "F18": (
        "existing classes, nothing eligible",
        [
            "formats::f18_every_mode_writes_what_the_table_says",
            "formats::f18_a_class_beyond_the_format_is_refused_when_planned",
            "faults::f18_nothing_to_look_at",
        ],
    ),
    "F19": (
        "flat, steep, cliff, dense, sparse",
        [
            "degenerate::bare_ground_is_found",
            "degenerate::sixty_degrees",
            "degenerate::a_cliff_is_terrain",
            "seamless::any_cut_gives_the_mask_of_the_whole_survey",
        ],
    ),
    "F20": (
        "COPC and EPT",
        ["formats::f20_a_copc_file_comes_out_as_plain_laz", "reader::variable_chunks_as_copc_has_them"],
    ),
    "F21": (
        "odd names",
        [
            "formats::f21_names_as_long_as_they_can_be",
            "survey::f21_equal_basenames_keep_their_folders",
            "survey::f21_names_that_cannot_be_stored_are_refused",
        ],
    ),
    "F22": (
        "names that lead out of the folder",
        [
            "survey::f22_no_name_leaves_the_output_folder",
            "faults_damage::f24_f22_no_run_over_its_inputs_or_out_of_its_folder",
            "faults_hostile::f22_notes_and_failures_of_a_stranger_lead_nowhere",
        ],
    ),
    "F23": (
        "a file changes during the run",
        ["reader::f23_changed_since_the_scan", "faults_damage::f23_a_tile_replaced_after_the_scan_is_set_aside"],
    ),
    "F24": (
        "no permission; output over input",
        [
            "survey::f24_permission_denied",
            "faults_damage::f24_f22_no_run_over_its_inputs_or_out_of_its_folder",
            "cluster::a_folder_that_cannot_be_written_is_seen",
        ],
    ),
    "F25": ("remote storage fails", LATER + "inputs and stores are local files"),
    "F30": (
        "a worker is killed in each stage",
        [
            "faults_cluster::f30_f34_workers_are_killed_and_stopped_in_each_stage",
            "faults_cluster::f30_f34_any_signal_in_any_stage",
        ],
    ),
    "F31": (
        "scheduler, client, everything is killed",
        [
            "faults_kill::f31_killed_again_and_again_at_random",
            "faults_cluster::f31_f32_interrupted_killed_and_given_again",
            "faults_cluster::f31_f32_any_end_in_any_stage",
            "faults_cluster::f31_a_lost_scheduler_is_named_and_a_new_one_goes_on",
        ],
    ),
    "F32": (
        "Ctrl-C once and twice, SIGTERM at the end of the wall time",
        [
            "faults_cluster::f31_f32_interrupted_killed_and_given_again",
            "faults_cluster::f31_f32_any_end_in_any_stage",
        ],
    ),
    "F33": (
        "a chunk that kills its workers",
        [
            "faults_kill::f33_work_that_kills_its_workers_is_tried_alone_and_given_up",
            "faults_cluster::f37_f33_a_second_run_is_refused_and_the_culprit_alone_is_set_aside",
        ],
    ),
    "F34": (
        "a stopped, a cut off, a slow worker, a late writer",
        [
            "faults_cluster::f34_a_cut_network_and_a_worker_twenty_times_slower",
            "faults_cluster::f30_f34_workers_are_killed_and_stopped_in_each_stage",
            "faults_kill::f39_f34_work_that_runs_twice_at_once_does_no_harm",
        ],
    ),
    "F35": (
        "disk full",
        [
            "faults_kill::f35_full_disk_in_the_store_ends_the_run_and_it_goes_on",
            "faults_kill::f35_full_disk_in_the_temporary_folder",
            "faults_kill::f35_full_disk_under_everything",
            "faults_cluster::f35_no_files_left_under_a_run",
            "faults_cluster::f35_no_room_to_spill",
        ],
    ),
    "F36": (
        "torn, missing, flipped, foreign, orphaned objects",
        [
            "faults_damage::f36_verify_finds_damage_and_the_next_run_mends_it",
            "faults_damage::f36_damaged_outputs_are_written_again",
            "faults_damage::f36_what_nobody_claims_is_listed_and_goes_away",
            "faults_damage::a_run_finds_damage_itself_goes_back_and_mends_it",
            "faults_hostile::f36_f52_a_ledger_written_by_a_stranger",
        ],
    ),
    "F37": (
        "two runs in one folder, locks of the dead",
        [
            "faults_damage::f37_a_second_run_is_refused_by_name",
            "faults_damage::f37_locks_of_the_dead_and_of_other_machines",
            "faults_cluster::f37_f33_a_second_run_is_refused_and_the_culprit_alone_is_set_aside",
        ],
    ),
    "F38": (
        "other parameters, inputs, versions, chunks",
        [
            "faults_damage::f38_changed_inputs_and_versions_are_refused_side_by_side",
            "engine::other_parameters_are_refused_by_name_and_accepted_on_request",
        ],
    ),
    "F39": ("the same task twice at once", ["faults_kill::f39_f34_work_that_runs_twice_at_once_does_no_harm"]),
    "F40": (
        "very many tiles, one chunk, a halo wider than a chunk",
        [
            "survey::f40_overlaps_of_a_hundred_thousand_tiles",
            "seamless::any_cut_gives_the_mask_of_the_whole_survey",
        ],
    ),
    "F41": (
        "the result does not depend on workers and cuts",
        [
            "seamless::any_cut_gives_the_mask_of_the_whole_survey",
            "seamless::processes_and_threads_write_the_same_bytes",
        ],
    ),
    "F42": ("workers with other versions or folders", ["cluster::each_fault_is_named"]),
    "F43": (
        "kernel cache on shared or read-only homes",
        LATER + "deployment (tests/test_numbacache.py holds what stands)",
    ),
    "F44": ("notebook: interrupted, restarted", LATER + "detached runs (tests/test_submit.py holds what stands)"),
    "F45": ("object store semantics", LATER + "the store is a local folder; no rename is assumed of it"),
    "F46": (
        "killed while a file is published; output exists",
        ["faults_kill::f46_killed_while_a_file_is_published", "mosaic::a_failure_leaves_the_old_file"],
    ),
    "F50": ("open scheduler without TLS", LATER + "deployment (tests/test_cluster.py holds what stands)"),
    "F51": ("wrong certificates", LATER + "deployment (tests/test_cluster.py holds what stands)"),
    "F52": ("nothing of ours unpickles from disk", LATER + "deployment; but see test_f52_nothing_unpickles_from_disk"),
    "F53": ("dashboard exposure", LATER + "deployment (tests/test_cluster.py holds what stands)"),
    "F54": ("shared login node", LATER + "deployment (tests/test_cluster.py holds what stands)"),
    "F55": ("temporary folders in world-writable places", ["faults::f55_temporary_folders_are_private"]),
    "F56": (
        "decompression bombs, giant records",
        [
            "reader::f5_f56_lying_layer_size_is_refused_before_decoding",
            "faults::f4_f56_regressions_of_the_fuzzer",
            "faults_hostile::f36_f56_an_array_that_claims_to_be_enormous_is_not_allocated",
        ],
    ),
    "F57": (
        "shell and template injection",
        [
            "faults::f57_no_shell",
            "faults_hostile::f57_no_option_or_name_reaches_a_shell",
            "faults_hostile::f57_configuration_is_data",
            "formats::f21_names_as_long_as_they_can_be",
        ],
    ),
    "F58": ("hostile names in HTML", ["survey::f58_hostile_names_are_escaped"]),
    "F59": ("containers", LATER + "deployment"),
}


def test_the_table_is_complete_and_its_tests_exist():
    wanted = [*range(1, 26), *range(30, 47), *range(50, 60)]
    assert list(TABLE) == [f"F{n}" for n in wanted]
    known: dict[str, set[str]] = {}
    for case, (_, tests) in TABLE.items():
        if isinstance(tests, str):
            assert tests.startswith(LATER)
            assert case in {"F25", "F43", "F44", "F45", "F50", "F51", "F52", "F53", "F54", "F59"}
            continue
        assert tests
        for test in tests:
            module, name = test.split("::")
            if module not in known:
                tree = ast.parse((HERE / f"test_{module}.py").read_text())
                known[module] = {n.name for n in ast.walk(tree) if isinstance(n, ast.FunctionDef)}
            assert f"test_{name}" in known[module], f"{case}: {test}"


# -- bad input --------------------------------------------------------------------------------------------------------


def test_f4_f56_regressions_of_the_fuzzer(tmp_path):
    for name, data in regressions(tmp_path):
        # A record may be 64 kB long, and a thousand of them are decoded at once.
        with no_more_than(3 * 1000 * 65536):
            try:
                check(data)
            except AssertionError as error:
                raise AssertionError(name) from error


@pytest.mark.skipif(importlib.util.find_spec("atheris") is None, reason="atheris is not installed (extra: fuzz)")
def test_f4_coverage_guided_fuzzing_for_a_while(tmp_path):
    """Two thousand inputs from a fixed seed; `python tests/fuzz_reader.py -max_total_time=3600` for longer."""
    command = [sys.executable, HERE / "fuzz_reader.py", "-runs=2000", "-seed=1", f"-artifact_prefix={tmp_path}/"]
    found = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert found.returncode == 0, found.stderr[-3000:]
    assert "no interesting inputs" not in found.stderr, "the reader is not watched"


def test_f9_arrays_with_nan_are_refused():
    for bad in (float("nan"), float("inf")):
        with pytest.raises(ParameterError, match="1 of 3 points have a coordinate that is NaN or infinite"):
            classify_ground([[0, 0, 0], [1, 1, 1], [2, bad, 2]])


def run_pmf(path: Path, out: Path):
    return plan(scan(path), RunParams(filter=PmfParams()), out=out).run(Inline())


def test_f9_a_far_outlier(tmp_path):
    """Its own chunk, no other difference: the chunks between do not exist."""
    mm = points(2000)
    near = run_pmf(write(tmp_path / "a.laz", mm, scale=0.01), tmp_path / "near")
    mm[7, 0] += 200_000_000
    far = run_pmf(write(tmp_path / "b.laz", mm, scale=0.01), tmp_path / "far")
    assert far.counts["chunks"] == near.counts["chunks"] + 1
    assert abs(far.counts["ground"] - near.counts["ground"]) <= 2
    assert far.counts["points"] == 2000


def test_f10_duplicates_keep_their_classes(tmp_path):
    import laspy

    mm = np.repeat(points(1000), 2, axis=0)
    classes = np.tile(np.array([1, 9], np.uint8), 1000)
    result = run_pmf(write(tmp_path / "a.laz", mm, classification=classes), tmp_path / "run")
    found = np.asarray(laspy.read(result.tiles[0]).classification)
    assert (found[1::2] == 9).all()
    assert set(found[::2]) == {1, 2}


def test_f18_nothing_to_look_at(tmp_path):
    result = run_pmf(write(tmp_path / "a.laz", points(500), classification=9), tmp_path / "run")
    assert result.counts["eligible"] == result.counts["ground"] == 0
    assert result.counts["points"] == 500
    assert np.isnan(result.dtm.values).all()


# -- security ---------------------------------------------------------------------------------------------------------


def sources() -> list[tuple[Path, ast.Module]]:
    package = HERE.parent / "ppdf_dask"
    return [(path, ast.parse(path.read_text())) for path in package.rglob("*.py")]


def test_f52_nothing_unpickles_from_disk():
    for path, tree in sources():
        for node in ast.walk(tree):
            names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            assert not {"pickle", "cloudpickle", "yaml", "marshal", "shelve"} & {n.split(".")[0] for n in names}, path


def test_f57_no_shell():
    for path, tree in sources():
        for node in ast.walk(tree):
            if isinstance(node, ast.Call):
                assert not any(k.arg == "shell" for k in node.keywords), path
                assert ast.unparse(node.func) not in ("os.system", "os.popen", "eval", "exec"), path


def test_f55_temporary_folders_are_private(tmp_path, monkeypatch):
    """Made exclusively, for their owner alone, gone at the end."""
    import tempfile

    from ppdf_dask import tiler

    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    seen = []
    true = tiler._Spool

    class Watched(true):
        def __init__(self, folder: Path) -> None:
            seen.append(folder.stat().st_mode & 0o777)
            super().__init__(folder)

    monkeypatch.setattr(tiler, "_Spool", Watched)
    run_pmf(write(tmp_path / "in" / "a.laz", points(500)), tmp_path / "run")
    assert seen == [0o700]
    assert not list(tmp_path.glob("ppdf-tile-*"))
