"""The command line, `splatjax COMMAND`: a file for a few commands. It calls the public interface
alone.
"""

from ._main import main as main
