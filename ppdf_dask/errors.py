"""Errors that say what to do next.

Every error a user can meet derives from `PpdfError`; its message names the file or the value, the place, and the
remedy. The command line turns them into one plain sentence and the exit code of the class.
"""


class PpdfError(Exception):
    """Base of all errors raised on purpose by this package."""

    exit_code = 1


class ParameterError(PpdfError, ValueError):
    """A parameter is outside its meaning; the message names it, its unit and the allowed range."""

    exit_code = 2


class SurveyError(PpdfError):
    """The input tiles cannot be used as they are; the message names the file and the option that helps."""

    exit_code = 2


class TileError(SurveyError):
    """One source file is unreadable, lies about itself or changed while it was in use."""


class PlanError(PpdfError):
    """The plan does not fit the memory, the disk or the raster limits; the message gives both numbers."""

    exit_code = 2


class StoreError(PpdfError):
    """The run's store is missing, incomplete, torn or belongs to another run."""


class DamagedError(StoreError):
    """An object of the store is missing, torn, flipped or not what the ledger says.

    Attributes
    ----------
    path : str
        The object's path in the store; it tells which work has to be done again.
    kind : str
        ``"missing"``, ``"torn"``, ``"flipped"`` or ``"foreign"``.
    """

    def __init__(self, message: str, path: str = "", kind: str = "torn") -> None:
        super().__init__(message, path, kind)
        self.path, self.kind = path, kind

    def __str__(self) -> str:
        return str(self.args[0])


class DiskFullError(StoreError):
    """There is no room, or no leave to write; the message says where. The same command goes on once there is."""


class LockedError(StoreError):
    """Another run works in the same folder; the message names who and where."""

    exit_code = 2


class ResumeError(StoreError):
    """Inputs, parameters or versions differ from those of the existing run; the message shows old and new."""

    exit_code = 2


class StoppedError(PpdfError):
    """The user stopped the run; what is done is in the ledger."""

    exit_code = 130


class PartialRunError(PpdfError):
    """The run ended, but some chunks or tiles could not be done; they are listed by name."""

    exit_code = 3


class ClusterError(PpdfError):
    """The scheduler or its workers cannot be used; the message says which check failed and where."""

    exit_code = 4
