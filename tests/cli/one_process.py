"""`splatjax` with plain renderers, as test_processes.py starts it several times over; killed where
it is told to be.
"""

import os
import signal
import sys
from functools import partial

import splatjax as sj
from splatjax.cli import main
from splatjax.diffusion import DenseDiffuser
from splatjax.splatting import DenseRasterizer, ShadowSettings

settings = sj.RenderSettings(
    shadows=ShadowSettings(resolution=32), rasterizer=DenseRasterizer(), diffuser=DenseDiffuser()
)
sj.make_plan = partial(sj.make_plan, settings=settings)
sj.render = partial(sj.render, settings=settings)
write_png = sj.write_png


def killed_before(path, frame, **how):
    if path.stem == os.environ.get("KILLED_BEFORE"):
        os.kill(os.getpid(), signal.SIGKILL)
    write_png(path, frame, **how)


sj.write_png = killed_before
sys.exit(main())
