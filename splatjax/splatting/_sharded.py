"""Passes 2 and 3 with the splats cut over devices: each bins and sums its own, and they meet once
after every stage.
"""

from collections.abc import Sequence
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from splatjax.devices import Devices
from splatjax.scene import Splats

from ._rasterizer import AbstractRasterizer, FragmentSums, SummedFragments
from ._settings import SplattingSettings
from ._shadows import Bounds
from ._stages import Stages, gaps, of_tiles
from ._sweeps import Sweep, backward, second_limits
from ._tiles import Binned, TileRasterizer
from ._views import AbstractView


class ShardedRasterizer(AbstractRasterizer):
    r"""A rasterizer of the splats of all devices, that each calls with its own, inside
    `jax.shard_map`.

    **Attributes:**

    - `part`: what each device does with its splats, with room for any device's.
    - `devices`: those that hold the splats.
    - `owners`: the device that goes on with each tile: the others find nothing there. `None`: every
      one has the whole picture.
    - `share`: how many tiles that show anything each device has room for. Static.
    """

    part: TileRasterizer
    devices: Devices
    owners: Int[Array, " tiles"] | None = None
    share: int = eqx.field(static=True, default=0)

    def planned(
        self, splats: Splats, views: Sequence[AbstractView], settings: SplattingSettings
    ) -> "ShardedRasterizer":
        raise ValueError(
            "a ShardedRasterizer is planned for a mesh: give `mesh` to splatjax.plan, and settings "
            "without one"
        )

    def summed(
        self,
        splats: Splats,
        attributes: Float[Array, "attributes splats"],
        view: AbstractView,
        settings: SplattingSettings,
    ) -> SummedFragments:
        binned = self.part.binned(splats, attributes, view, settings)
        front, behind, shown = _swept(
            binned.sweep, self.devices, binned.bins, binned.shift, binned.planes, binned.attributes
        )
        needed = binned.bins.needed.astype(attributes.dtype)
        if self.owners is None:
            return SummedFragments(
                *self.devices.total((front, behind)), self.devices.largest(needed)
            )
        owned, more = self._owned(shown, self.owners)
        both = jnp.concatenate([front.rows(), behind.rows()], axis=1)
        own = self.devices.own_share(of_tiles(both, owned.reshape(-1), 0))
        whole = jnp.zeros_like(both).at[owned[self.devices.index()]].set(own, mode="drop")
        front, behind = (FragmentSums.of(each) for each in jnp.split(whole, 2, axis=1))
        return SummedFragments(front, behind, self.devices.largest(jnp.maximum(needed, more)))

    def _owned(
        self, shown: Float[Array, " tiles"], owners: Int[Array, " tiles"]
    ) -> tuple[Int[Array, "devices share"], Float[Array, ""]]:
        """List the tiles that show anything by their owner, then the number of all; and how many
        there are over the room.
        """
        own = (shown > 0)[None] & (
            owners[None] == jnp.arange(self.devices.count, dtype=jnp.int32)[:, None]
        )
        listed = jax.vmap(
            lambda tiles: jnp.nonzero(tiles, size=self.share, fill_value=tiles.shape[0])[0]
        )(own)
        return listed.astype(jnp.int32), jnp.max(jnp.sum(own, axis=1)).astype(
            shown.dtype
        ) / self.share


def bounds_over(splats: Splats, devices: Devices) -> Bounds:
    """Give what `Bounds.of` gives, of the splats of all devices. Those without a radius fill a
    share and do not count.
    """
    there = splats.radii > 0
    low, high = (
        devices.extreme(jnp.where(there[:, None], splats.centers, sign * jnp.inf), largest=sign < 0)
        for sign in (1, -1)
    )
    center = 0.5 * (low + high)
    offset = splats.centers - center[None]
    squared = devices.extreme(
        jnp.where(there, jnp.sum(offset * offset, axis=1), -jnp.inf), largest=True
    )
    apart = squared > 0
    reach = jnp.where(apart, jnp.sqrt(jnp.where(apart, squared, 1.0)), 0.0)
    return Bounds(center, reach + devices.extreme(splats.radii, largest=True))


def _forward(sweep: Sweep, devices: Devices, bins, shift, planes, attributes):
    stages = Stages.of(Binned(sweep, bins, shift, planes, attributes))
    limits = devices.largest(stages.limits())
    front = stages.front(limits)
    open_to = gaps(limits, devices.total(front.weights), sweep.full_coverage)
    seconds = second_limits(*devices.largest(stages.limits_behind(limits, open_to)))
    behind = stages.behind(limits, seconds)
    shown = jnp.any(limits > -jnp.inf, axis=1).astype(shift.dtype)
    poison = bins.poison(shift.dtype)
    return (*jax.tree.map(lambda sums: sums + poison, (front, behind)), shown), (limits, seconds)


@partial(jax.custom_vjp, nondiff_argnums=(0, 1))
def _swept(
    sweep: Sweep,
    devices: Devices,
    bins,
    shift: Float[Array, " splats"],
    planes: tuple[Float[Array, " splats"], ...],
    attributes: tuple[Float[Array, " splats"], ...],
):
    """Sum attributes over this device's splats of both surfaces, that end where all devices' do;
    and say which tiles show any.
    """
    return _forward(sweep, devices, bins, shift, planes, attributes)[0]


def _swept_fwd(sweep: Sweep, devices: Devices, bins, shift, planes, attributes):
    found, limits = _forward(sweep, devices, bins, shift, planes, attributes)
    return found, (bins, shift, planes, attributes, limits)


def _swept_bwd(sweep: Sweep, devices: Devices, residuals, cotangents):
    bins, shift, planes, attributes, limits = residuals
    front, behind, _ = cotangents
    by_lane = tuple(of_tiles(each, bins.order[: bins.places], jnp.inf) for each in limits)
    by_lane = jnp.where(by_lane[0] > -jnp.inf, by_lane[0], jnp.inf), by_lane[1]
    return (None, None, *backward(sweep, bins, shift, planes, attributes, by_lane, (front, behind)))


_swept.defvjp(_swept_fwd, _swept_bwd)
