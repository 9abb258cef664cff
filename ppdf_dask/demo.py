"""The demo: a small synthetic survey with known ground, the whole job, the errors."""

from __future__ import annotations

from pathlib import Path

from ppdf_dask.metrics import Scores, pooled
from ppdf_dask.result import Result


def make_demo(folder: Path) -> Path:
    """Write the demo survey, four tiles of forest on a hillside and their truth, and return the tiles' folder."""
    from ppdf_dask.synthetic import DEMO, write_survey

    write_survey(folder, DEMO)
    return folder / "tiles"


def demo_scores(folder: Path, result: Result) -> list[Scores]:
    """Compare each classified tile of the demo with its truth, labelled noise and water aside."""
    import laspy
    import numpy as np

    scores = []
    for path in result.tiles:
        truth = np.asarray(laspy.read(folder / "truth" / path.name).classification)
        found = np.asarray(laspy.read(path).classification)
        scores.append(Scores.from_masks(truth == 2, found == 2, ~np.isin(truth, (7, 9, 18))))
    return scores


def evaluate_demo(folder: Path, result: Result) -> str:
    """Return the errors of a demo run as text."""
    import numpy as np

    from ppdf_dask.synthetic import DEMO, true_height

    scores = pooled(demo_scores(folder, result))
    dtm = result.dtm
    x, y = np.meshgrid(dtm.x.values, dtm.y.values)
    error = dtm.values - true_height(x, y, DEMO)
    rmse = float(np.sqrt(np.nanmean(error**2)))
    return "\n".join(
        (
            "Against the known ground:",
            f"  total error {scores.total:.2%}, type I {scores.type_i:.2%}, type II {scores.type_ii:.2%}, "
            f"kappa {scores.kappa:.1%}",
            f"  terrain model: RMSE {rmse:.3f} m over {int(np.isfinite(error).sum()):,} pixels",
            f"Look at {result.out / 'dtm.tif'} and {result.out / 'laz'}.",
        )
    )
