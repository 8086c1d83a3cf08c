"""The passes with the splats cut over the devices of a mesh: each works on its splats, then on its
strip of the picture.
"""

from collections.abc import Callable
from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.sharding import Mesh, PartitionSpec
from jaxtyping import Array, Float, PyTree

from splatjax.devices import Devices, laid_out
from splatjax.scene import Scene

from ._passes import SeenSurfaces
from ._records import Plan
from ._sharded_plan import filled_up, plan_specs

Found = TypeVar("Found", bound=PyTree)


def over(
    mesh: Mesh,
    share: Callable[..., Found],
    scene: Scene,
    plan: Plan,
    *rest: PyTree,
    rows: tuple[Float[Array, "splats channels"], ...] = (),
    found: PartitionSpec | None = None,
) -> Found:
    """Let every device do its share, with a plan that is made for a mesh. Gradients go back to
    where the splats are.

    **Arguments:**

    - `share`: what one device does: of the devices, then of scene, plan, `rest` and `rows` as it
      has them, its own splats alone.
    - `rest`: what every device has whole.
    - `rows`: one for each splat, and cut as the splats are.
    - `found`: how what the shares give lies over the devices; `None` for what is the same on all.
    """
    devices, count = Devices.of(mesh), scene.splats.count
    scene = Scene(filled_up(scene.splats, devices), scene.lights, scene.material)
    rows = tuple(jnp.pad(each, ((0, scene.splats.count - count), (0, 0))) for each in rows)
    of_scene, of_rest = jax.tree.map(lambda _: PartitionSpec(), (scene, rest))
    of_scene = eqx.tree_at(
        lambda each: each.splats, of_scene, jax.tree.map(lambda _: devices.shares, scene.splats)
    )
    given, specs = (
        (scene, plan, rest, rows),
        (of_scene, plan_specs(plan, devices), of_rest, (devices.shares,) * len(rows)),
    )

    def whole_share(scene, plan, rest, rows):
        return share(devices, scene, plan, *rest, *rows)

    # Without a check of what varies over devices: rules of our own derivatives, and loops, are not
    # written for it.
    gives = PartitionSpec() if found is None else found
    whole_share = jax.shard_map(
        whole_share, mesh=mesh, in_specs=specs, out_specs=gives, check_vma=False
    )
    return whole_share(*laid_out(mesh, given, specs))


def of_all(seen: SeenSurfaces, devices: Devices) -> SeenSurfaces:
    """Give what a picture is laid together by: the places of all devices' strips, and the shares of
    their pixels.
    """
    parts = seen.atlas.of_all(devices), devices.everything(seen.share)
    return eqx.tree_at(lambda each: (each.atlas, each.share), seen, parts)
