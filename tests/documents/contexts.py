"""What reference pages take for granted, small: pages that teach stand for themselves."""

import jax
import jax.numpy as jnp
import numpy as np

import splatjax as sj
from splatjax.diffusion import DenseDiffuser
from splatjax.splatting import DenseRasterizer, ShadowSettings

_SIDE = 24
_COARSE = ShadowSettings(resolution=48, bias=1.0, softness=2.0)


def _figurine() -> sj.Splats:
    bust = sj.bust(900)
    return sj.Splats(bust.centers / 8, bust.normals, bust.radii / 8, bust.areas / 64)


def _seen(side: int = _SIDE) -> dict:
    splats = _figurine()
    camera = sj.Camera.look_at(
        jnp.asarray([8.0, 0.0, 70.0]),
        jnp.asarray([0.0, -3.5, 0.0]),
        fov=32.0,
        width=side,
        height=side,
    )
    lights = (sj.DirectionalLight(jnp.asarray([-1.0, -0.3, -0.4]), jnp.full(3, jnp.pi)),)
    material = sj.load_material("marble")
    return {
        "jax": jax,
        "jnp": jnp,
        "np": np,
        "sj": sj,
        "splats": splats,
        "camera": camera,
        "lights": lights,
        "material": material,
    }


def scene() -> dict:
    """A scene, a camera, and something to compare with."""
    names = _seen()
    medium = sj.load_medium("marble")
    material = sj.Material(sj.fit_gaussians(sj.Dipole(medium)).gaussians)
    made = sj.Scene(names["splats"], names["lights"], material)
    return names | {"scene": made, "target": jnp.zeros((_SIDE, _SIDE, 3)), "medium": medium}


def pictures() -> dict:
    """A picture of marble, taken by the renderer itself, and an optimizer."""
    import optax

    names = _seen()
    settings = sj.RenderSettings(
        shadows=_COARSE, rasterizer=DenseRasterizer(), diffuser=DenseDiffuser()
    )
    material = sj.Material(names["material"].gaussians, eta=1.5, specular=0.0)
    picture = np.asarray(
        sj.render(
            sj.Scene(names["splats"], names["lights"], material), names["camera"], settings
        ).beauty
    )
    noise = np.full(picture.shape, 0.01 * float(np.sqrt(np.mean(picture**2))))
    return names | {"picture": picture, "noise": noise, "optax": optax, "material": material}


def devices() -> dict:
    """A scene and how it is cut; there is no cluster to join."""
    from types import SimpleNamespace

    from jax.sharding import NamedSharding, PartitionSpec

    names = _seen()
    made = sj.Scene(names["splats"], names["lights"], names["material"])
    cameras = jax.tree.map(lambda leaf: jnp.stack([leaf] * jax.device_count()), names["camera"])
    alone = SimpleNamespace(**vars(jax) | {"distributed": SimpleNamespace(initialize=lambda: None)})
    cut = {"NamedSharding": NamedSharding, "PartitionSpec": PartitionSpec}
    return (
        names
        | cut
        | {
            "jax": alone,
            "splatjax": sj,
            "scene": made,
            "plan": sj.make_plan(made, names["camera"]),
            "cameras": cameras,
        }
    )


CONTEXTS = {
    "docs/devices.md": devices,
    "docs/gradients.md": scene,
    "docs/figures.md": scene,
    "docs/baselines.md": scene,
    "docs/recovery.md": pictures,
}
