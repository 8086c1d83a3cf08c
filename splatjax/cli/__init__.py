"""The command line, `splatjax COMMAND`, which uses only the public interface."""

from ._main import main as main, run_and_exit as run_and_exit
