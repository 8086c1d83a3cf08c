"""A plan for splats that are cut over the devices of a mesh."""

from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental.multihost_utils import process_allgather
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import PyTree

from splatjax import diffusion as _diffusion, splatting as _splatting
from splatjax.devices import Devices
from splatjax.scene import Splats

from ._records import Plan, ShadowPlan, Wanted

Whole = TypeVar("Whole", bound=PyTree)


def on_one_device(tree: Whole) -> Whole:
    """Gather what may lie on several devices, and on those of several processes, for planning."""

    def gathered(leaf):
        if not isinstance(leaf, jax.Array) or isinstance(
            leaf.sharding, jax.sharding.SingleDeviceSharding
        ):
            return leaf
        return jnp.asarray(
            np.asarray(leaf) if leaf.is_fully_addressable else process_allgather(leaf, tiled=True)
        )

    return jax.tree.map(gathered, tree)


def filled_up(splats: Splats, devices: Devices) -> Splats:
    """Add splats that nobody sees and that bring no light, so that each device has as many."""
    return filled_up_to(splats, max(-(-splats.count // devices.count), 1) * devices.count)


def filled_up_to(splats: Splats, count: int) -> Splats:
    """Add splats that nobody sees and that bring no light."""
    lacking = count - splats.count
    if lacking == 0:
        return splats
    if splats.count == 0:
        return jax.tree.map(lambda leaf: jnp.zeros((lacking, *leaf.shape[1:]), leaf.dtype), splats)
    last = jax.tree.map(
        lambda leaf: jnp.broadcast_to(leaf[-1:], (lacking, *leaf.shape[1:])), splats
    )
    last = Splats(
        last.centers,
        *(jnp.zeros_like(each) for each in (last.normals, last.radii, last.areas)),
        *_carried(last),
    )
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), splats, last)


def _carried(splats: Splats):
    return splats.albedo, splats.specular, splats.roughness


def plan_over(mesh: Mesh, wanted: Wanted) -> Plan:
    """Cut the splats into a share for each device of a mesh, and the tiles of the pictures into
    strips.

    **Raises:** `ValueError` when the settings' rasterizer or diffuser cannot be cut.
    """
    settings, devices = wanted.settings, Devices.of(mesh)
    of_each = settings.rasterizer
    if not isinstance(of_each, _splatting.TileRasterizer):
        raise ValueError(
            f"over a mesh the rasterizer must be a TileRasterizer, not a {type(of_each).__name__}"
        )
    if not isinstance(settings.diffuser, _diffusion.ClusterDiffuser):
        raise ValueError(
            "over a mesh the diffuser must be a ClusterDiffuser, not a "
            f"{type(settings.diffuser).__name__}"
        )
    whole = filled_up(wanted.splats, devices)
    rows = whole.count // devices.count
    parts = [
        jax.tree.map(lambda leaf, i=i: leaf[i * rows : (i + 1) * rows], whole)
        for i in range(devices.count)
    ]
    looks = [np.asarray(look) for look in wanted.looks]
    owners = _owners(looks, devices.count)
    owned = [[np.where(owners == i, look, -np.inf) for i in range(devices.count)] for look in looks]

    def rasterizer(views, **tiles) -> _splatting.ShardedRasterizer:
        part = of_each.planned_for_each(parts, views, settings.splatting)
        return _splatting.ShardedRasterizer(part, devices, **tiles)

    share = _splatting.round_up(
        max(int(np.sum(own[0] > -np.inf)) for each in owned for own in each), 1
    )
    tiles = _splatting.round_up(
        max(int(np.sum(own > -np.inf)) for each in owned for own in each), 1
    )
    cut = [
        _splatting.Atlas.of(jnp.asarray(own), view, tiles)
        for each, view in zip(owned, wanted.views, strict=True)
        for own in each
    ]
    uncut = [
        _splatting.Atlas.of(look, view, look.size)
        for look, view in zip(wanted.looks, wanted.views, strict=True)
    ]
    diffuser = settings.diffuser.planned(wanted.splats, wanted.kernels, wanted.interval, cut)
    made = Plan(
        rasterizer=rasterizer(wanted.views, owners=jnp.asarray(owners.reshape(-1)), share=share),
        tiles=tiles,
        shadows=tuple(
            None if each is None else ShadowPlan(rasterizer(each.views), each.cube)
            for each in wanted.shadows
        ),
        diffuser=_diffusion.ShardedDiffuser.of(
            diffuser, wanted.splats, parts, wanted.kernels, uncut, devices
        ),
        interval=wanted.interval,
        mesh=mesh,
        splats=wanted.splats.count,
    )
    return jax.tree.map(
        lambda leaf, spec: jax.device_put(leaf, NamedSharding(mesh, spec)),
        made,
        plan_specs(made, devices),
    )


def plan_specs(plan: Plan, devices: Devices) -> Plan:
    """Say what of a plan every device has whole, and what it has a share of."""
    specs = jax.tree.map(lambda _: PartitionSpec(), plan)
    return eqx.tree_at(
        lambda each: (each.diffuser.order, each.diffuser.parents),
        specs,
        (devices.shares, devices.shares),
    )


def _owners(looks, count: int) -> np.ndarray:
    """Give each tile `[down, across]` to a device: strips along rows, each with as much to see of
    all pictures.
    """
    seen = np.cumsum(sum((look > -np.inf).sum(axis=0) for look in looks).reshape(-1))
    strips = (
        np.minimum((seen - 1) * count // max(int(seen[-1]), 1), count - 1) if seen.size else seen
    )
    return np.maximum(strips, 0).astype(np.int32).reshape(looks[0].shape[1:])
