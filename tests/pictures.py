"""Pictures written by a library of others."""

import numpy as np
import OpenImageIO as oiio


def write_picture(path, values, kind="float"):
    file = oiio.ImageOutput.create(str(path))
    spec = oiio.ImageSpec(values.shape[1], values.shape[0], values.shape[2], kind)
    spec["oiio:UnassociatedAlpha"] = 1
    assert file.open(str(path), spec)
    assert file.write_image(values.astype(np.float32))
    assert file.close()
    return path
