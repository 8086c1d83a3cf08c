"""The command line, `splatjax COMMAND`: a file for a command or two. It calls the public interface
alone.
"""

from ._main import main as main
