"""What a camera or a near light sees, and what a light at infinity sees."""

import equinox as eqx
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array, Float

from splatjax.scene import Camera, Splats

from ._views import (
    EDGE_ON,
    MARGIN,
    AbstractView,
    Footprints,
    SplattingSettings,
    epsilon_of,
    filtered,
    rows,
)


class PerspectiveView(AbstractView):
    """What a pinhole camera sees."""

    position: Float[Array, "3"]
    rotation: Float[Array, "3 3"]
    focal_length: Float[Array, ""]
    """In pixels."""
    width: int = eqx.field(static=True)
    height: int = eqx.field(static=True)
    near: float = eqx.field(static=True)

    @classmethod
    def of(cls, camera: Camera) -> "PerspectiveView":
        focal_length = camera.focal_length * camera.height
        return cls(
            position=camera.position,
            rotation=camera.rotation,
            focal_length=focal_length,
            width=camera.width,
            height=camera.height,
            near=camera.near,
        )

    def footprints(self, splats: Splats, settings: SplattingSettings) -> Footprints:
        px, py, pz = rows(self.rotation, (splats.centers - self.position[None]).T)
        in_sight = self._in_sight(px, py, pz, splats.radii)
        pz = jnp.where(in_sight, pz, 1.0)
        u, v, scale = px / pz, py / pz, self.focal_length / pz
        # All below is homogeneous in the normal and the radius (pixels): the normal is taken that
        # long.
        radius = splats.radii * self.focal_length / pz
        nx, ny, nz = (
            n * splats.radii * self.focal_length / pz for n in rows(self.rotation, splats.normals.T)
        )
        facing = -(nx * u + ny * v + nz)
        visible = in_sight & (facing > EDGE_ON * radius)
        # The disc's ellipse: S = r^2 P (I - n n^T) P^T, with P = [[1, 0, -u], [0, 1, -v]].
        an, bn = u * nx + nz, v * ny + nz
        xx = ny * ny * (1 + u * u) + an * an
        xy = u * ny * bn + v * nx * an - nx * ny
        yy = nx * nx * (1 + v * v) + bn * bn
        across, along = radius * facing, radius * radius
        dx, dy = -facing * along * nx / self.focal_length, -facing * along * ny / self.focal_length
        vx = (along * u + (nx - u * nz) * nz) / self.focal_length
        vy = (along * v + (ny - v * nz) * nz) / self.focal_length
        a, b, c, gx, gy, xx, yy, root = filtered(
            xx, xy, yy, across, dx, dy, vx, vy, settings.filter_radius
        )
        opacity = jnp.where(visible, across / root, 0.0)
        inverse = 1 / pz
        square = inverse * inverse
        # The rim is a conic; its box is exact while the splat does not reach the plane of the
        # pinhole.
        ux, uy = xx * gx + xy * gy, xy * gx + yy * gy
        kappa = stop_gradient(1 - (gx * ux + gy * uy))
        bounded = kappa > 1e-3
        kappa = jnp.where(bounded, kappa, 1.0)
        x, y = self.width / 2 + self.focal_length * u, self.height / 2 + self.focal_length * v
        mid_x, mid_y = stop_gradient(ux / kappa), stop_gradient(uy / kappa)
        half_x = stop_gradient(jnp.sqrt(jnp.where(bounded, (xx + ux * mid_x) / kappa, jnp.inf)))
        half_y = stop_gradient(jnp.sqrt(jnp.where(bounded, (yy + uy * mid_y) / kappa, jnp.inf)))
        cosine = facing / (radius * jnp.sqrt(1 + u * u + v * v))
        epsilon = epsilon_of(splats.radii, settings.filter_radius / scale, cosine, settings)
        return Footprints(
            x=x,
            y=y,
            slope_x=gx * inverse,
            slope_y=gy * inverse,
            a=a * square,
            b=b * square,
            c=c * square,
            nearness=inverse,
            shift=stop_gradient(1 / (1 + epsilon * inverse)),
            opacity=opacity,
            left=stop_gradient(x) + mid_x - half_x,
            right=stop_gradient(x) + mid_x + half_x,
            top=stop_gradient(y) + mid_y - half_y,
            bottom=stop_gradient(y) + mid_y + half_y,
            visible=visible,
        )

    def may_see(self, splats):
        px, py, pz = rows(self.rotation, (splats.centers - self.position[None]).T)
        nx, ny, nz = rows(self.rotation, splats.normals.T)
        return self._in_sight(px, py, pz, splats.radii) & (nx * px + ny * py + nz * pz < 0)

    def _in_sight(self, x, y, z, radii):
        """Mark the spheres that touch the pyramid of the picture. Others, far to the side, are
        beyond what float32 projects.
        """

        def beside(offset, size):
            half = 0.5 * size + MARGIN
            return jnp.abs(offset) * self.focal_length - z * half < radii * jnp.sqrt(
                self.focal_length**2 + half**2
            )

        return (z > self.near) & beside(x, self.width) & beside(y, self.height)

    @staticmethod
    def inside(nearness, quadric):
        return (quadric < nearness * nearness) & (nearness > 0)

    @staticmethod
    def squared_radius(nearness, quadric):
        return quadric / (nearness * nearness)

    @staticmethod
    def squared_radius_vjp(nearness, squared_radius, cotangent):
        z = 1 / nearness
        return -2 * cotangent * squared_radius * z, cotangent * z * z

    @staticmethod
    def shifted(nearness, shift):
        return nearness * shift

    @staticmethod
    def depth(nearness):
        return 1 / nearness

    def project(self, points):
        offset = points - self.position.reshape(3, *[1] * (points.ndim - 1))
        x, y, z = jnp.tensordot(self.rotation, offset, 1)
        safe = jnp.where(z > self.near, z, 1.0)
        column, row = (
            self.width / 2 + self.focal_length * x / safe,
            self.height / 2 + self.focal_length * y / safe,
        )
        return column, row, z

    def slant(self, x, y, depth, normals):
        nx, ny, nz = jnp.tensordot(self.rotation, normals, 1)
        u, v = (x - self.width / 2) / self.focal_length, (y - self.height / 2) / self.focal_length
        mm = jnp.where(depth > self.near, depth, 1.0) / self.focal_length
        return nx * mm, ny * mm, -(nz + nx * u + ny * v)

    def unproject(self, x, y, depth):
        u, v = (x - self.width / 2) / self.focal_length, (y - self.height / 2) / self.focal_length
        along = jnp.stack([u * depth, v * depth, depth])
        return jnp.tensordot(self.rotation.T, along, 1) + self.position.reshape(
            3, *[1] * depth.ndim
        )


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
