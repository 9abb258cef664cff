"""The comparison and the site statistics as Markdown, CSV and JSON."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ppdf_dask import __version__
from ppdf_dask.experiments.compare import Comparison
from ppdf_dask.experiments.tables import markdown, number, plain
from ppdf_dask.experiments.workers import Row
from ppdf_dask.metrics import MeanStd, mean_std, pooled

RATES = {
    "total": "total %",
    "type_i": "type I %",
    "type_ii": "type II %",
    "kappa": "kappa %",
    "precision": "precision %",
}
"""The rates of the paper's Figure 11 and their headings."""

SIX = (
    "The six sites are synthetic: they have the densities of the PPDF paper's Table 1 and span its ranges of slope, "
    "cover and canopy height. The paper's own six sites and labels are not public, so that its figures cannot be "
    "reproduced on them."
)
"""What a study of the synthetic sites must say."""

_FORMULA = ("=", "+", "-", "@")


@dataclass(frozen=True)
class Report:
    """A comparison in words and tables.

    Attributes
    ----------
    comparison : Comparison
        The results.
    remark : str
        Stands below the title.
    """

    comparison: Comparison
    remark: str = ""

    def markdown(self) -> str:
        """Return the whole report."""
        found = self.comparison
        parts = [
            "# Ground filters compared",
            self.remark,
            "## Mean and standard deviation over the sites",
            *self._means(),
        ]
        for rate, heading in RATES.items():
            parts += [f"## {heading} per site", self._per_site(lambda r, rate=rate: 100 * getattr(r.scores, rate))]  # type: ignore[misc]
        parts += ["## RMSE of the 1 m terrain model per site, m", self._per_site(lambda r: r.rmse, 3)]
        parts += ["## Processor time of the filter per site, s", self._per_site(lambda r: r.cpu)]
        parts += ["## The sites", sites_markdown(found.sites)]
        if found.tuned:
            parts += ["## Tuning", *self._tuning()]
        notes = sorted({f"- {r.case.name}, {r.site}: {note}" for r in found.rows for note in r.notes})
        if notes:
            parts += ["## Warnings of the filters", "\n".join(notes)]
        if found.failures:
            parts += ["## Could not be done", "\n".join(f"- {f.stage} {f.ident}: {f.error}" for f in found.failures)]
        return "\n\n".join(p for p in parts if p)

    def summary(self) -> str:
        """Return the first table alone."""
        return self._means()[0]

    def csv(self) -> str:
        """Return a line per case and site: counts, rates as shares of 1, metres and seconds."""
        head = [
            "filter",
            "profile",
            "site",
            "points",
            "offered",
            *"cdab",
            *RATES,
            "rmse_m",
            "missing",
            "seconds",
            "cpu_seconds",
        ]
        lines = [
            [
                r.case.filter,
                r.case.profile,
                r.site,
                r.points,
                r.offered,
                *(getattr(r.scores, k) for k in "cdab"),
                *(getattr(r.scores, rate) for rate in RATES),
                r.rmse,
                r.missing,
                r.seconds,
                r.cpu,
            ]
            for r in self.comparison.rows
        ]
        return csv_text(head, lines)

    def as_dict(self) -> dict[str, Any]:
        """Return everything as plain JSON types; a rate that is not defined is None."""
        found = self.comparison
        out: dict[str, Any] = plain(
            {
                "version": __version__,
                "remark": self.remark,
                "sites": list(found.sites),
                "cases": [self._case(name) for name in found.cases],
                "rows": [_row(r) for r in found.rows],
                "tuning": [{"filter": g.filter, "name": g.name, "axes": dict(g.axes)} for g in found.tuned],
                "failures": [{"stage": f.stage, "ident": f.ident, "error": f.error} for f in found.failures],
            }
        )
        return out

    def _case(self, name: str) -> dict[str, Any]:
        rows = self.comparison.of(name)
        over = mean_std([r.scores for r in rows])
        stats = {rate: {"mean": over[rate].mean, "std": over[rate].std, "n": over[rate].n} for rate in RATES}
        whole = pooled(r.scores for r in rows).as_dict()
        return {"case": name, **stats, "pooled": {k: whole[k] for k in (*"cdab", *RATES)}, "points_per_s": _speed(rows)}

    def _means(self) -> list[str]:
        head = ["filter", "sites", *RATES.values(), "RMSE m", "missing %", "s a site", "Mpts/s"]
        lines = []
        for name in self.comparison.cases:
            rows = self.comparison.of(name)
            over = mean_std([r.scores for r in rows])
            rates = [_both(over[rate], 100, 2 if rate != "kappa" else 1) for rate in RATES]
            heights = [
                number(_mean([r.rmse for r in rows]), 3),
                number(_mean([r.missing for r in rows]), 2, 100),
            ]
            times = [number(_mean([r.cpu for r in rows])), number(_speed(rows), 3, 1e-6)]
            lines.append([_safe(name), str(len(rows)), *rates, *heights, *times])
        note = (
            "Mean ± sample standard deviation (n - 1), each site with the same weight. Each filter sees the returns it "
            "asks for by default; points it does not see count as not ground. RMSE: the 1 m terrain model less that of "
            "the reference's ground, where both know a height; missing: pixels where only the reference does. Times: "
            "processor time of the filter alone, one thread, after a first run on a few points; Mpts/s counts the "
            "points it saw."
        )
        return [markdown(head, lines), note]

    def _per_site(self, value: Callable[[Row], float], digits: int = 2) -> str:
        names = [s["site"] for s in self.comparison.sites]
        lines = []
        for case in self.comparison.cases:
            known = {r.site: value(r) for r in self.comparison.of(case)}
            lines.append([_safe(case), *(number(known.get(name, math.nan), digits) for name in names)])
        return markdown(["filter", *map(_safe, names)], lines)

    def _tuning(self) -> list[str]:
        text = (
            "For each site the combination with the lowest mean total error over all **other** sites, so that no "
            "filter is scored on a site that it was tuned on."
        )
        searched = [
            f"- {g.filter} {g.name} (from {g.profile}): "
            + "; ".join(f"{k} in {', '.join(f'{v:g}' for v in values)}" for k, values in g.axes.items())
            for g in self.comparison.tuned
        ]
        chosen = []
        for g in self.comparison.tuned:
            for r in self.comparison.of(f"{g.filter} {g.name}"):
                values = r.case.params.as_dict()
                chosen.append([f"{g.filter} {g.name}", _safe(r.site), ", ".join(f"{k} {values[k]:g}" for k in g.axes)])
        return [text, "\n".join(searched), markdown(["filter", "site", "chosen on the others"], chosen)]


def sites_markdown(sites: Iterable[dict[str, Any]]) -> str:
    """Return the table of the sites: what the paper's Table 1 and Figures 3 and 4 give."""
    head = ["site", "points", "points/m2", "ground points", "slope deg", "canopy cover %", "canopy height m"]
    return markdown(
        head,
        [
            [
                _safe(s["site"]),
                f"{s['points']:,}",
                number(s["density"]),
                f"{s['ground']:,}",
                number(s["slope_deg"], 1),
                number(s["cover"], 1, 100),
                number(s["canopy_height_m"], 1),
            ]
            for s in sites
        ],
    )


def sites_csv(sites: Sequence[dict[str, Any]]) -> str:
    """Return the sites as CSV, a line per site."""
    head = ["site", "points", "density", "ground", "slope_deg", "cover", "canopy_height_m"]
    return csv_text(head, [[s[k] for k in head] for s in sites])


def csv_text(head: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """Return CSV text that no spreadsheet takes for a formula; numbers that are not defined are empty.

    Parameters
    ----------
    head : sequence of str
        Names of the columns.
    rows : iterable of sequence
        Texts and numbers. A text that begins with ``= + - @`` gets an apostrophe before it, as OWASP advises ("CSV
        injection"), and what does not print, such as tabs and line breaks, becomes a space: names of files may come
        from anywhere.

    Examples
    --------
    >>> csv_text(["site", "kappa"], [["=1+1", -0.25], ["b", float("nan")]]).splitlines()
    ['site,kappa', "'=1+1,-0.25", 'b,']
    """
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    for row in [head, *rows]:
        writer.writerow([_cell(value) for value in row])
    return out.getvalue()


def _cell(value: Any) -> Any:
    if isinstance(value, str):
        value = _printable(value)
        return f"'{value}" if value.lstrip().startswith(_FORMULA) else value
    return "" if isinstance(value, float) and math.isnan(value) else value


def _row(r: Row) -> dict[str, Any]:
    return {
        "site": r.site,
        "filter": r.case.filter,
        "profile": r.case.profile,
        "params": r.case.params.as_dict(),
        **r.scores.as_dict(),
        "rmse_m": r.rmse,
        "missing": r.missing,
        "points": r.points,
        "offered": r.offered,
        "seconds": r.seconds,
        "cpu_seconds": r.cpu,
        "notes": list(r.notes),
    }


def _speed(rows: Sequence[Row]) -> float:
    """Return the points seen per second of processor time over all sites."""
    spent = math.fsum(r.cpu for r in rows)
    return sum(r.offered for r in rows) / spent if spent > 0 else math.nan


def _mean(values: Sequence[float]) -> float:
    known = [v for v in values if math.isfinite(v)]
    return float(np.mean(known)) if known else math.nan


def _both(rate: MeanStd, scale: float, digits: int) -> str:
    return f"{number(rate.mean, digits, scale)} ± {number(rate.std, digits, scale)}"


def _safe(name: str) -> str:
    """Keep a name from ending a table's cell or line."""
    return _printable(name).replace("|", "\\|")


def _printable(text: str) -> str:
    return "".join(c if c.isprintable() else " " for c in text)
