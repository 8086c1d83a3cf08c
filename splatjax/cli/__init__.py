"""The command line, `splatjax COMMAND`, which uses only the public interface."""

from ._main import main as main
