"""The command line, `splatjax COMMAND`. It uses only the public interface."""

from ._main import main as main
