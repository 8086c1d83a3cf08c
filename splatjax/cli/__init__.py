"""The command line, `splatjax COMMAND`: a file per command. It calls the public interface alone."""

from ._main import main as main
