"""Errors and warnings of the library.

Every message is one line: what is wrong, the offending value, and what to do about it.
"""

from __future__ import annotations

import enum
import inspect
import re
import warnings
from collections.abc import Iterable
from pathlib import Path

# Most characters of a message, and of its words while it has more.
_MESSAGE, _WORDS = 600, (160, 80, 40)


def shortened(text: object, most: int = 80) -> str:
    """The text of a value for a message: of a long one the beginning and the end, with an ellipsis between them."""
    words = str(text)
    return words if len(words) <= most else f"{words[: most // 2]}…{words[-(most - most // 2 - 1) :]}"


def quoted(value: object, most: int = 80) -> str:
    """A value as Python writes it, shortened."""
    try:
        return shortened(repr(value), most)
    except ValueError:  # Python writes no integers of thousands of digits
        return f"a very long {type(value).__name__}"


def concise(message: object) -> str:
    """A message in one line of at most 600 characters.

    Words are shortened first, such as names of thousands of letters. If that is not enough, the middle of the message is left
    out: it begins with the thing, and ends with what to do.
    """
    line = " ".join(str(message).splitlines())
    for most in _WORDS:
        if len(line) > _MESSAGE:
            line = " ".join(shortened(word, most) for word in line.split(" "))
    return shortened(line, _MESSAGE)


class ShadowmapError(ValueError):
    """Bad input to shadowmap_dr: a scene, an option or an array that cannot be used as given.

    Its text is one line of at most 600 characters; ``args`` keeps what was left out.
    """

    def __str__(self) -> str:
        return concise(super().__str__())


class UnsupportedShape(ShadowmapError):
    """A shape that cannot be rendered, but that a scene can be rendered without."""


class LLVMError(ShadowmapError, ImportError):
    """No LLVM library that Dr.Jit can compile with."""


class OutputError(ShadowmapError, OSError):
    """A result could not be written (unwritable directory, full disk, unknown suffix)."""


def mitsuba_message(error: BaseException) -> str:
    """Message of an exception of Mitsuba's, in one line, without positions in its source."""
    if isinstance(error, UnicodeError):  # Mitsuba quotes what it cannot read
        return "a file that it names is damaged."
    text = re.sub(r"\[\w+\.(?:cpp|h):\d+\] ?", "", " ".join(str(error).split()))
    return "a parameter has a value of the wrong type." if text == "std::bad_cast" else text


def nearest(word: object, known: Iterable[object]) -> str | None:
    """The known word that a mistyped one most resembles, or the only one that it begins, or the first that it ends; None if none
    is near."""
    from difflib import get_close_matches  # only mistyped words need it

    typed, words = str(word), [str(one) for one in known]
    begun = [one for one in words if typed and one.startswith(typed)]
    ended = [one for one in words if typed and one.endswith(f"_{typed}")]
    if ended:
        return ended[0]
    close = get_close_matches(typed, words, 1)
    return begun[0] if len(begun) == 1 else close[0] if close else None


def did_you_mean(word: object, known: Iterable[object]) -> str:
    """A question with the nearest of the known words, to be put behind a sentence; empty if none is near."""
    found = nearest(word, known)
    return "" if found is None else f" Did you mean {found!r}?"


#: Folder of the package: in a checkout, `pyproject.toml` lies beside it.
_PACKAGE = Path(__file__).resolve().parent


def install_hint(extra: str) -> str:
    """Command that installs the packages of an extra, in the way in which this package was installed.

    In a checkout: ``pip install '.[extra]'`` and the folder, with ``-e`` for an editable installation. Elsewhere: names of the
    missing packages, as this package may be on no index.
    """
    import importlib.metadata as metadata

    try:
        own = metadata.distribution("shadowmap-dr")
        needs, origin = own.requires or [], own.read_text("direct_url.json") or ""
    except metadata.PackageNotFoundError:
        needs, origin = [], ""
    folder = _PACKAGE.parent
    if (folder / "pyproject.toml").is_file():
        return f"pip install {'-e ' if re.search(r'.editable.: *true', origin) else ''}'.[{extra}]' in {folder}"
    marked = re.compile(rf"(?P<needed>(?P<name>[\w.-]+)[^;]*?) *;.*\bextra *== *['\"]{re.escape(extra)}['\"]")
    found = [match for match in map(marked.fullmatch, needs) if match]
    missing = [match for match in found if not _is_installed(match["name"])]
    words = [repr(match["needed"]) for match in missing or found]
    return f"pip install {' '.join(words)}" if words else f"install the packages of the extra {extra!r}"


def _is_installed(package: str) -> bool:
    import importlib.metadata as metadata

    try:
        metadata.version(package)
    except metadata.PackageNotFoundError:
        return False
    return True


class Verbosity(enum.IntEnum):
    """Amount of text that commands print beside their results."""

    #: Errors only.
    QUIET = 0
    #: Progress, notes and warnings, too.
    USUAL = 1
    #: Versions, times, origins of warnings and tracebacks, too.
    VERBOSE = 2


_VERBOSITY = [Verbosity.USUAL]


def verbosity() -> Verbosity:
    """The verbosity of this process."""
    return _VERBOSITY[0]


def set_verbosity(level: Verbosity) -> None:
    """Set the verbosity of this process. Commands do it, by their options ``--quiet`` and ``--verbose``."""
    _VERBOSITY[0] = level


def is_interrupt(error: BaseException | None) -> bool:
    """True if an error is Ctrl-C, or the error that Dr.Jit raises for Ctrl-C while it replays a recorded function."""
    while error is not None:
        if isinstance(error, KeyboardInterrupt):
            return True
        error = error.__cause__ or error.__context__
    return False


# Packages whose frames a warning skips: it points to the code that called them.
_CALLED = ("shadowmap_dr", "mitsuba", "drjit")


def warn(message: str) -> None:
    """Issue a ``UserWarning`` that points to the line that called this package or Mitsuba."""
    level, frame = 1, inspect.currentframe()
    while frame is not None and frame.f_globals.get("__name__", "").partition(".")[0] in _CALLED:
        level, frame = level + 1, frame.f_back
    warnings.warn(message, stacklevel=level)


def check_variant(current: str | None, made_for: str) -> None:
    """Raise ShadowmapError unless the current variant is the one for which a renderer was made."""
    if current != made_for:
        raise ShadowmapError(f"The variant is {current}, but this renderer was made for {made_for}: set that one.")
