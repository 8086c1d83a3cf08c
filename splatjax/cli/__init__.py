"""The command line: `splatjax materials | fit | sample | render`. It calls the public interface, and nothing else."""

from ._main import main as main
