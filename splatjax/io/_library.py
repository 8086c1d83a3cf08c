"""Errors of the libraries that read meshes, said in one sentence."""

import logging
import warnings
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def readable(path: Path, kind: str) -> Generator[None, None, None]:
    """Let whatever a library raises name the file, say why and what to do.

    **Raises:** `ValueError`; errors that already name the file pass.
    """
    log = logging.getLogger("trimesh")
    before = log.level
    log.setLevel(logging.CRITICAL)  # what is wrong is said here
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", DeprecationWarning)  # NumPy's, of numbers that are none
            warnings.filterwarnings("ignore", "loadtxt: input contained no data")  # an empty list
            yield
    except Exception as error:  # each reader fails in its own way
        if isinstance(error, (ValueError, OSError)) and str(error).startswith(str(path.parent)):
            raise
        said = " ".join(str(error).split())[:200]
        if not isinstance(error, ValueError):
            said = f"an entry is missing or wrong ({type(error).__name__} {said})"
        raise ValueError(
            f"{path}: cannot be read as {kind}: {said}; it is cut short or wrong, write it again"
        ) from None
    finally:
        log.setLevel(before)
