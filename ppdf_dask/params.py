"""Parameter objects: frozen, validated, with units and a fingerprint.

Each filter declares its own subclass of `Parameters` beside its code; this module holds the base class and the
parameters of a run. Lengths are metres, angles degrees, slopes tangents; the unit stands in each field's metadata and
in every error message.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
import typing
from dataclasses import dataclass, field, fields
from typing import Any, ClassVar, Literal, Self

from ppdf_dask.errors import ParameterError

Returns = Literal["last", "all"]
Mode = Literal["update", "refine", "reset"]


def quantity(default: Any, unit: str, *, low: float | None = None, high: float | None = None, doc: str = "") -> Any:
    """Declare a numeric field with its unit and its closed range.

    Parameters
    ----------
    default : float, int or None
        The default; None allows None as a value ("derive it").
    unit : str
        Unit as shown to the user: ``"m"``, ``"points"``, ``"1"`` for ratios and tangents.
    low, high : float, optional
        Smallest and largest allowed value, both included.
    doc : str, optional
        One line for ``--help`` and the tables.

    Returns
    -------
    dataclasses.Field
        A field for a `Parameters` subclass.

    Examples
    --------
    >>> @dataclass(frozen=True, kw_only=True)
    ... class Window(Parameters):
    ...     size: float = quantity(10.0, "m", low=0.1)
    >>> Window(size=0.0)
    Traceback (most recent call last):
        ...
    ppdf_dask.errors.ParameterError: size = 0.0 m is below the smallest allowed value, 0.1 m
    """
    return field(
        default=default,
        metadata={"unit": unit, "low": low, "high": high, "doc": doc, "optional": default is None},
    )


@dataclass(frozen=True, kw_only=True)
class Parameters:
    """Base of every parameter object: validates itself, compares by value, has a fingerprint."""

    RETURNS: ClassVar[Returns] = "last"
    """For a filter's parameters: the returns it is offered unless the user says otherwise."""

    def __post_init__(self) -> None:
        hints = typing.get_type_hints(type(self))
        for f in fields(self):
            value = getattr(self, f.name)
            if f.metadata.get("unit") is not None:
                _check_quantity(f, value)
                if int in (hints[f.name], *typing.get_args(hints[f.name])) and not isinstance(value, int | None):
                    unit = "" if f.metadata["unit"] == "1" else f" {f.metadata['unit']}"
                    raise ParameterError(f"{f.name} = {value!r}{unit} is not a whole number")
            elif hints[f.name] is bool and not isinstance(value, bool):
                raise ParameterError(f"{f.name} = {value!r} is neither true nor false")
            elif typing.get_origin(hints[f.name]) is Literal:
                choices = typing.get_args(hints[f.name])
                if not isinstance(value, str) or value not in choices:
                    raise ParameterError(
                        f"{f.name} = {value!r} is unknown; choose one of {', '.join(map(repr, choices))}"
                    )

    def as_dict(self) -> dict[str, Any]:
        """Return the fields as plain JSON types, nested parameter objects as dicts with their ``kind``."""
        return {"kind": type(self).__name__} | {f.name: _plain(getattr(self, f.name)) for f in fields(self)}

    def fingerprint(self) -> str:
        """Return 16 hexadecimal digits that change when any value changes, on any machine.

        Examples
        --------
        >>> DtmParams().fingerprint() == DtmParams(resolution=1.0).fingerprint()
        True
        >>> DtmParams().fingerprint() == DtmParams(resolution=0.5).fingerprint()
        False
        """
        text = json.dumps(self.as_dict(), sort_keys=True, separators=(",", ":"))
        return hashlib.sha256(text.encode()).hexdigest()[:16]

    def replace(self, **changes: Any) -> Self:
        """Return a copy with some values changed; the copy is validated anew."""
        known = {f.name for f in fields(self)}
        for name in changes:
            if name not in known:
                raise ParameterError(
                    f"{type(self).__name__} has no parameter {name!r}; it has {', '.join(sorted(known))}"
                )
        return dataclasses.replace(self, **changes)

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> Self:
        """Build the object from `as_dict` or from a table of a TOML file; unknown names are refused."""
        known = {f.name for f in fields(cls)}
        given = {k: tuple(v) if isinstance(v, list) else v for k, v in values.items() if k != "kind"}
        for name in given:
            if name not in known:
                raise ParameterError(f"{cls.__name__} has no parameter {name!r}; it has {', '.join(sorted(known))}")
        return cls(**given)


def _plain(value: Any) -> Any:
    if isinstance(value, Parameters):
        return value.as_dict()
    if isinstance(value, tuple):
        return [_plain(v) for v in value]
    return value


def _check_quantity(f: dataclasses.Field[Any], value: Any) -> None:
    unit, low, high = f.metadata["unit"], f.metadata["low"], f.metadata["high"]
    if value is None and f.metadata["optional"]:
        return
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise ParameterError(f"{f.name} = {value!r} is not a finite number of {unit}")
    if low is not None and value < low:
        raise ParameterError(f"{f.name} = {value} {unit} is below the smallest allowed value, {low} {unit}")
    if high is not None and value > high:
        raise ParameterError(f"{f.name} = {value} {unit} is above the largest allowed value, {high} {unit}")


@dataclass(frozen=True, kw_only=True)
class ClassRules(Parameters):
    """Which points the filter sees and which classes are written (the table of the README's section on classes).

    Parameters
    ----------
    returns : {"last", "all"} or None
        ``"last"``: last and only returns (a return number of 0 of 0 counts as only); None: what the filter's
        parameter object asks for (robust: last, paper: all).
    mode : {"update", "refine", "reset"}
        ``"update"``: found ground becomes `ground_class`, an eligible former 2 not found ground becomes 1, everything
        else stays. ``"refine"``: an existing 2 stays 2 and is a reference. ``"reset"``: every eligible non-ground point
        becomes 1.
    ground_class : int
        ASPRS class written for ground.
    from_classes : tuple of int or None
        Only these classes are seen; None: all but noise (7, 18), water (9), virtual and user-defined (64 and up).
    skip_overlap, use_withheld : bool
        Leave out points with the overlap flag or old class 12; let in points flagged withheld.
    """

    returns: Returns | None = None
    mode: Mode = "update"
    ground_class: int = quantity(2, "class", low=0, high=255)
    from_classes: tuple[int, ...] | None = None
    skip_overlap: bool = False
    use_withheld: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.returns is not None and self.returns not in typing.get_args(Returns):
            raise ParameterError(f"returns = {self.returns!r} is unknown; choose 'last' or 'all'")
        # A configuration file may hold anything here.
        classes: Any = () if self.from_classes is None else self.from_classes
        if not isinstance(classes, tuple) or not all(type(c) is int and 0 <= c <= 255 for c in classes):
            raise ParameterError(f"from_classes = {classes!r} must be a list of ASPRS classes between 0 and 255")


@dataclass(frozen=True, kw_only=True)
class ChunkParams(Parameters):
    """How the survey is cut; none of these changes a PPDF result.

    Parameters
    ----------
    chunk_size : float or None
        Edge of a chunk's core in metres, rounded up to a multiple of 5 m; None: chosen from the header densities so
        that a task fits its memory.
    buffer : float or None
        First guess of the buffer in metres; None: what the filter declares.
    max_buffer : float
        The widest buffer a task may try before it gives up on a point it cannot prove.
    """

    chunk_size: float | None = quantity(None, "m", low=5.0, high=100_000.0)
    buffer: float | None = quantity(None, "m", low=0.0, high=100_000.0)
    max_buffer: float = quantity(2000.0, "m", low=0.0, high=100_000.0)


@dataclass(frozen=True, kw_only=True)
class DtmParams(Parameters):
    """The terrain model's raster.

    Parameters
    ----------
    resolution : float
        Pixel size in metres; pixel edges lie at its multiples.
    max_edge : float
        A triangle with a longer edge, or with an empty circle of a larger radius, gives no height, so that lakes and
        the survey's outside stay NaN.
    fill_edge : float or None
        Also make a filled variant: the same surface with this larger limit instead of `max_edge`; None: no such thing.
    """

    resolution: float = quantity(1.0, "m", low=0.05, high=1000.0)
    max_edge: float = quantity(50.0, "m", low=0.1, high=10_000.0)
    fill_edge: float | None = quantity(None, "m", low=0.1, high=10_000.0)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.fill_edge is not None and self.fill_edge < self.max_edge:
            raise ParameterError(
                f"fill_edge = {self.fill_edge} m is below max_edge = {self.max_edge} m; filling needs a larger limit"
            )


@dataclass(frozen=True, kw_only=True)
class RunParams(Parameters):
    """Everything that shapes a run's result: the filter's parameters, class rules, chunking and raster.

    Parameters
    ----------
    filter : Parameters
        Parameter object of the filter to run; default the robust profile of PPDF.
    classes, chunks, dtm : ClassRules, ChunkParams, DtmParams
        See there.
    """

    EXACT_FIELDS: ClassVar[tuple[str, ...]] = ("filter", "classes", "dtm")

    filter: Parameters = field(default_factory=lambda: _default_filter())
    classes: ClassRules = field(default_factory=ClassRules)
    chunks: ChunkParams = field(default_factory=ChunkParams)
    dtm: DtmParams = field(default_factory=DtmParams)

    @property
    def returns(self) -> Returns:
        """The returns the filter sees: the rule's, or else the filter's own default."""
        return self.classes.returns or self.filter.RETURNS


def _default_filter() -> Parameters:
    from ppdf_dask.filters.ppdf.robust.params import RobustParams

    return RobustParams()
