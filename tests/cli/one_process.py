"""`splatjax` with plain renderers, which tests start several times over and may kill at a given
moment.
"""

import os
import signal
import sys

from bodies import PLAIN

import splatjax as sj
from splatjax.cli import _render, main

_render.PictureOptions.settings = PLAIN
write_png = sj.write_png


def killed_before(path, frame, **how):
    if path.stem == os.environ.get("KILLED_BEFORE"):
        os.kill(os.getpid(), signal.SIGKILL)
    write_png(path, frame, **how)


sj.write_png = killed_before
sys.exit(main())
