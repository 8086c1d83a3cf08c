"""The command line: `splatjax materials | fit | export | sample | render | turntable`. It calls the public interface alone."""

from ._main import main as main
