"""Which splatjax wrote a file."""

from importlib.metadata import PackageNotFoundError, version


def own_version() -> str:
    """Give the version of the package that is installed."""
    try:
        return version("splatjax")
    except PackageNotFoundError:
        return "(not installed)"
