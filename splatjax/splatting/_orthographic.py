"""What a light at infinity sees."""

import equinox as eqx
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array, Float

from splatjax.scene import Splats

from ._footprints import EDGE_ON, Footprints, SplattingSettings, epsilon_of, filtered
from ._views import MARGIN, AbstractView, rows


class OrthographicView(AbstractView):
    """What a light at infinity sees. `position` is seen at the center of the picture, at
    depth 0.
    """

    position: Float[Array, "3"]
    rotation: Float[Array, "3 3"]
    scale: Float[Array, ""]
    """Pixels per mm."""
    width: int = eqx.field(static=True)
    height: int = eqx.field(static=True)

    def footprints(self, splats: Splats, settings: SplattingSettings) -> Footprints:
        px, py, pz = rows(self.rotation, (splats.centers - self.position[None]).T)
        nx, ny, nz = rows(self.rotation, splats.normals.T)
        visible = nz < -EDGE_ON
        squared = (splats.radii * self.scale) ** 2
        xx, xy, yy = (
            squared * (ny * ny + nz * nz),
            squared * (-nx * ny),
            squared * (nx * nx + nz * nz),
        )
        across, along = -squared * nz, squared / self.scale
        dx, dy = across * along * nx, across * along * ny
        vx, vy = -along * nz * nx, -along * nz * ny
        a, b, c, gx, gy, xx, yy, root = filtered(
            xx, xy, yy, across, dx, dy, vx, vy, settings.filter_radius
        )
        x, y = self.width / 2 + self.scale * px, self.height / 2 + self.scale * py
        half_x, half_y = jnp.sqrt(xx), jnp.sqrt(yy)
        filter_radius = jnp.broadcast_to(settings.filter_radius / self.scale, splats.radii.shape)
        return Footprints(
            x=x,
            y=y,
            slope_x=-gx,
            slope_y=-gy,
            a=a,
            b=b,
            c=c,
            nearness=-pz,
            shift=stop_gradient(epsilon_of(splats.radii, filter_radius, -nz, settings)),
            opacity=jnp.where(visible, across / root, 0.0),
            left=stop_gradient(x - half_x),
            right=stop_gradient(x + half_x),
            top=stop_gradient(y - half_y),
            bottom=stop_gradient(y + half_y),
            visible=visible,
        )

    def may_see(self, splats):
        x, y, _ = rows(self.rotation, (splats.centers - self.position[None]).T)
        _, _, facing = rows(self.rotation, splats.normals.T)
        inside_x = jnp.abs(x) < 0.5 * (self.width + 2 * MARGIN) / self.scale + splats.radii
        return (
            inside_x
            & (jnp.abs(y) < 0.5 * (self.height + 2 * MARGIN) / self.scale + splats.radii)
            & (facing < 0)
        )

    @staticmethod
    def inside(nearness, quadric):
        return quadric < 1

    @staticmethod
    def squared_radius(nearness, quadric):
        return quadric

    @staticmethod
    def squared_radius_vjp(nearness, squared_radius, cotangent):
        return jnp.zeros_like(nearness), cotangent

    @staticmethod
    def shifted(nearness, shift):
        return nearness - shift

    @staticmethod
    def depth(nearness):
        return -nearness

    def project(self, points):
        offset = points - self.position.reshape(3, *[1] * (points.ndim - 1))
        x, y, z = jnp.tensordot(self.rotation, offset, 1)
        return self.width / 2 + self.scale * x, self.height / 2 + self.scale * y, z

    def slant(self, x, y, depth, normals):
        nx, ny, nz = jnp.tensordot(self.rotation, normals, 1)
        return nx / self.scale, ny / self.scale, -nz

    def unproject(self, x, y, depth):
        along = jnp.stack(
            [(x - self.width / 2) / self.scale, (y - self.height / 2) / self.scale, depth]
        )
        return jnp.tensordot(self.rotation.T, along, 1) + self.position.reshape(
            3, *[1] * depth.ndim
        )
