"""Views of cameras and near lights (perspective), and of distant lights (orthographic)."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array, Float

from splatjax._chunking import rounded_up
from splatjax.scene import Camera, Splats

from ._grid import TILE_SIDE
from ._views import (
    EDGE_ON,
    MARGIN,
    AbstractView,
    Footprints,
    SplattingSettings,
    epsilon_of,
    rotate,
    widen_ellipse,
)


class PerspectiveView(AbstractView):
    """The view of a pinhole camera; `focal_length` is in pixels, and so is `principal_pixel`, where
    the forward axis meets the picture; `None` for the middle.
    """

    focal_length: Float[Array, ""]
    width: int = eqx.field(static=True)
    height: int = eqx.field(static=True)
    near: float = eqx.field(static=True)
    principal_pixel: tuple[Float[Array, ""], Float[Array, ""]] | None = None

    @classmethod
    def of(cls, camera: Camera) -> "PerspectiveView":
        return cls(
            position=camera.position,
            rotation=camera.rotation,
            focal_length=camera.focal_length * camera.height,
            width=camera.width,
            height=camera.height,
            near=camera.near,
            principal_pixel=None if camera.principal_point is None else camera.principal_pixel,
        )

    @classmethod
    def padded(cls, camera: Camera) -> "PerspectiveView":
        """Return the view of a camera with further pixels on the right and below, by a sixteenth
        of each side at most, so that pictures of nearby sizes share a program.
        """
        dtype = camera.position.dtype
        view, (column, row) = cls.of(camera), camera.principal_pixel
        return dataclasses.replace(
            view,
            width=rounded_up(camera.width, TILE_SIDE, per_octave=16),
            height=rounded_up(camera.height, TILE_SIDE, per_octave=16),
            principal_pixel=(jnp.asarray(column, dtype), jnp.asarray(row, dtype)),
        )

    def enlarged(self, camera: Camera) -> "PerspectiveView":
        """Return the view of a camera on the grid of this one, enlarged to fill it: its capacity
        suffices for all smaller pictures of the same field of view.
        """
        scale = min(self.width / camera.width, self.height / camera.height)
        column, row = self.axis_pixel
        return dataclasses.replace(
            self,
            focal_length=scale * self.focal_length,
            principal_pixel=(scale * column, scale * row),
        )

    @property
    def axis_pixel(self):
        return super().axis_pixel if self.principal_pixel is None else self.principal_pixel

    def footprints(self, splats: Splats, settings: SplattingSettings) -> Footprints:
        px, py, pz = rotate(self.rotation, (splats.centers - self.position[None]).T)
        in_sight = self._in_sight(px, py, pz, splats.radii)
        pz = jnp.where(in_sight, pz, 1.0)
        u, v, scale = px / pz, py / pz, self.focal_length / pz
        # All below is homogeneous in the normal and the radius r (pixels), so the normal n is
        # scaled to this length.
        radius = splats.radii * self.focal_length / pz
        nx, ny, nz = (
            n * splats.radii * self.focal_length / pz
            for n in rotate(self.rotation, splats.normals.T)
        )
        # r times the cosine to the line of sight, times the length of (u, v, 1).
        facing = -(nx * u + ny * v + nz)
        visible = in_sight & (facing > EDGE_ON * radius)
        # The disc's ellipse: S = P (r^2 I - n n^T) P^T, with P = [[1, 0, -u], [0, 1, -v]]. With r^2
        # = nx^2 + ny^2 + nz^2, squares remain instead of differences.
        tilt_x, tilt_y = u * nx + nz, v * ny + nz
        xx = ny * ny * (1 + u * u) + tilt_x * tilt_x
        xy = u * ny * tilt_y + v * nx * tilt_x - nx * ny
        yy = nx * nx * (1 + v * v) + tilt_y * tilt_y
        root_determinant, squared_radius = radius * facing, radius * radius
        # Slopes are relative here: those of nearness over the nearness of the center.
        (a, b, c), (gx, gy), (xx, yy), filtered_determinant = widen_ellipse(
            xx,
            xy,
            yy,
            root_determinant=root_determinant,
            det_slope=(
                -facing * squared_radius * nx / self.focal_length,
                -facing * squared_radius * ny / self.focal_length,
            ),
            s_slope=(
                (squared_radius * u + (nx - u * nz) * nz) / self.focal_length,
                (squared_radius * v + (ny - v * nz) * nz) / self.focal_length,
            ),
            filter_radius=settings.filter_radius,
        )
        inverse = 1 / pz
        square = inverse * inverse
        # With the relative slope g, the rim is the conic d^T S^-1 d = (1 + g . d)^2: an ellipse
        # while 1 - g^T S g is positive, where the splat does not reach the plane of the pinhole.
        s_gx, s_gy = xx * gx + xy * gy, xy * gx + yy * gy
        kappa = stop_gradient(1 - (gx * s_gx + gy * s_gy))
        bounded = kappa > 1e-3
        kappa = jnp.where(bounded, kappa, 1.0)
        middle_x, middle_y = self.axis_pixel
        x, y = middle_x + self.focal_length * u, middle_y + self.focal_length * v
        mid_x, mid_y = stop_gradient(s_gx / kappa), stop_gradient(s_gy / kappa)
        squared_x, squared_y = (xx + s_gx * mid_x) / kappa, (yy + s_gy * mid_y) / kappa
        half_x, half_y = (
            stop_gradient(jnp.sqrt(jnp.where(bounded, squared, jnp.inf)))
            for squared in (squared_x, squared_y)
        )
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
            opacity=jnp.where(visible, root_determinant / filtered_determinant, 0.0),
            box=(
                stop_gradient(x) + mid_x - half_x,
                stop_gradient(x) + mid_x + half_x,
                stop_gradient(y) + mid_y - half_y,
                stop_gradient(y) + mid_y + half_y,
            ),
            visible=visible,
        )

    def may_see(self, splats):
        px, py, pz = rotate(self.rotation, (splats.centers - self.position[None]).T)
        nx, ny, nz = rotate(self.rotation, splats.normals.T)
        return self._in_sight(px, py, pz, splats.radii) & (nx * px + ny * py + nz * pz < 0)

    def _in_sight(self, x, y, z, radii):
        """Mark the spheres that touch the pyramid of the picture. Float32 cannot project others far
        to the side.
        """

        def beside(offset, size, middle):
            half = MARGIN + (
                0.5 * size
                if self.principal_pixel is None
                else jnp.where(offset > 0, size - middle, middle)
            )
            return jnp.abs(offset) * self.focal_length - z * half < radii * jnp.sqrt(
                self.focal_length**2 + half**2
            )

        middle_x, middle_y = self.axis_pixel
        beside_x, beside_y = beside(x, self.width, middle_x), beside(y, self.height, middle_y)
        return (z > self.near) & beside_x & beside_y

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

    def depth_slope(self, x, y, depth, normals):
        nx, ny, nz = jnp.tensordot(self.rotation, normals, 1)
        u, v = self._slopes(x, y)
        mm = self.pixel_size(depth)
        return nx * mm, ny * mm, -(nz + nx * u + ny * v)

    def _slopes(self, x, y):
        middle_x, middle_y = self.axis_pixel
        return (x - middle_x) / self.focal_length, (y - middle_y) / self.focal_length

    def pixel_size(self, depth):
        return jnp.where(depth > self.near, depth, 1.0) / self.focal_length

    def unproject(self, x, y, depth):
        u, v = self._slopes(x, y)
        along = jnp.stack([u * depth, v * depth, depth])
        return jnp.tensordot(self.rotation.T, along, 1) + self.position.reshape(
            3, *[1] * depth.ndim
        )


class OrthographicView(AbstractView):
    """The view of a distant light. `position` is at the center of the picture, at depth 0; `scale`
    is in pixels per mm.
    """

    scale: Float[Array, ""]
    width: int = eqx.field(static=True)
    height: int = eqx.field(static=True)

    def footprints(self, splats: Splats, settings: SplattingSettings) -> Footprints:
        px, py, pz = rotate(self.rotation, (splats.centers - self.position[None]).T)
        nx, ny, nz = rotate(self.rotation, splats.normals.T)
        visible = nz < -EDGE_ON
        squared_radius = (splats.radii * self.scale) ** 2
        root_determinant, per_pixel = -squared_radius * nz, squared_radius / self.scale
        # Slopes are those of the depth, mm per pixel.
        (a, b, c), depth_slopes, squares, filtered_determinant = widen_ellipse(
            squared_radius * (ny * ny + nz * nz),
            squared_radius * (-nx * ny),
            squared_radius * (nx * nx + nz * nz),
            root_determinant=root_determinant,
            det_slope=(root_determinant * per_pixel * nx, root_determinant * per_pixel * ny),
            s_slope=(-per_pixel * nz * nx, -per_pixel * nz * ny),
            filter_radius=settings.filter_radius,
        )
        x, y = self.width / 2 + self.scale * px, self.height / 2 + self.scale * py
        half_x, half_y = (jnp.sqrt(squared) for squared in squares)
        return Footprints(
            x=x,
            y=y,
            slope_x=-depth_slopes[0],
            slope_y=-depth_slopes[1],
            a=a,
            b=b,
            c=c,
            nearness=-pz,
            shift=stop_gradient(
                epsilon_of(splats.radii, settings.filter_radius / self.scale, -nz, settings)
            ),
            opacity=jnp.where(visible, root_determinant / filtered_determinant, 0.0),
            box=stop_gradient((x - half_x, x + half_x, y - half_y, y + half_y)),
            visible=visible,
        )

    def may_see(self, splats):
        x, y, _ = rotate(self.rotation, (splats.centers - self.position[None]).T)
        _, _, facing = rotate(self.rotation, splats.normals.T)
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

    def depth_slope(self, x, y, depth, normals):
        nx, ny, nz = jnp.tensordot(self.rotation, normals, 1)
        return nx / self.scale, ny / self.scale, -nz

    def pixel_size(self, depth):
        return 1 / self.scale

    def unproject(self, x, y, depth):
        along = jnp.stack(
            [(x - self.width / 2) / self.scale, (y - self.height / 2) / self.scale, depth]
        )
        return jnp.tensordot(self.rotation.T, along, 1) + self.position.reshape(
            3, *[1] * depth.ndim
        )
