"""Where splats land in a picture: perspective for the camera, orthographic for distant lights.

A splat is a disc. In the picture its rim is an ellipse, and a fragment of it is described by numbers that are
polynomials in the offset `d` (pixels) from the projected center:

    nearness  e(d)  = nearness + slope . d          1 / z in perspective, -z without
    quadric   n(d)  = a dx^2 + b dx dy + c dy^2
    rho^2           = n / e^2 in perspective, n without: 1 on the rim

so that the surface in front has the largest nearness and no fragment needs a square root.
"""

import abc

import equinox as eqx
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array, Bool, Float

from splatjax.scene import Camera, Splats

from ._settings import SplattingSettings


class Footprints(eqx.Module):
    """Where every splat lands, planar: one array per number. Pixels, origin top left, unless said otherwise."""

    x: Float[Array, " splats"]
    y: Float[Array, " splats"]
    slope_x: Float[Array, " splats"]
    slope_y: Float[Array, " splats"]
    a: Float[Array, " splats"]
    b: Float[Array, " splats"]
    c: Float[Array, " splats"]
    nearness: Float[Array, " splats"]
    shift: Float[Array, " splats"]
    """How the surface is moved away by epsilon (3.1); not differentiated."""
    opacity: Float[Array, " splats"]
    """What the screen filter leaves of the peak weight: 1 for large frontal splats, 0 edge on."""
    left: Float[Array, " splats"]
    right: Float[Array, " splats"]
    top: Float[Array, " splats"]
    bottom: Float[Array, " splats"]
    """The rim's bounding box. Not differentiated."""
    visible: Bool[Array, " splats"]


class AbstractView(eqx.Module):
    """A projection of the world onto pixels."""

    width: eqx.AbstractVar[int]
    height: eqx.AbstractVar[int]

    @abc.abstractmethod
    def footprints(self, splats: Splats, settings: SplattingSettings) -> Footprints:
        """Project splats. Splats that face away or are seen edge on, or lie before the near plane, are not visible."""

    @abc.abstractmethod
    def may_see(self, splats: Splats) -> Bool[Array, " splats"]:
        """Say which splats face the eye, with spheres that touch the picture: cheap, and never too few."""

    @staticmethod
    @abc.abstractmethod
    def inside(nearness: Float[Array, "..."], quadric: Float[Array, "..."]) -> Bool[Array, "..."]:
        """Say whether a fragment lies within the rim."""

    @staticmethod
    @abc.abstractmethod
    def squared_radius(nearness: Float[Array, "..."], quadric: Float[Array, "..."]) -> Float[Array, "..."]:
        """Give `rho^2`, in units of the splat's radius, for a fragment inside."""

    @staticmethod
    @abc.abstractmethod
    def squared_radius_vjp(
        nearness: Float[Array, "..."], squared_radius: Float[Array, "..."], cotangent: Float[Array, "..."]
    ) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
        """Give the cotangents of nearness and quadric for one of `rho^2`."""

    @staticmethod
    @abc.abstractmethod
    def shifted(nearness: Float[Array, "..."], shift: Float[Array, "..."]) -> Float[Array, "..."]:
        """Give the nearness of a fragment moved away from the eye by epsilon."""

    @staticmethod
    @abc.abstractmethod
    def depth(nearness: Float[Array, "..."]) -> Float[Array, "..."]:
        """Give the depth (mm along the forward axis) of a nearness."""

    @abc.abstractmethod
    def project(self, points: Float[Array, "3 *points"]) -> tuple[Float[Array, "*points"], ...]:
        """Give column, row (pixels) and depth (mm) of points."""

    @abc.abstractmethod
    def slant(
        self,
        x: Float[Array, "*points"],
        y: Float[Array, "*points"],
        depth: Float[Array, "*points"],
        normals: Float[Array, "3 *points"],
    ) -> tuple[Float[Array, "*points"], Float[Array, "*points"], Float[Array, "*points"]]:
        """Give, for planes at projected points, two numbers and a third whose quotients are the depth's slope, mm per pixel.

        The third is the cosine-like factor that vanishes where a plane is seen edge on."""

    @abc.abstractmethod
    def pixels_per_mm(self, depth: Float[Array, "*points"]) -> Float[Array, "*points"]:
        """Give the size of a millimetre across the line of sight, pixels."""

    @abc.abstractmethod
    def sphere_box(
        self, centers: Float[Array, "3 spheres"], radii: Float[Array, " spheres"]
    ) -> tuple[Float[Array, " spheres"], ...]:
        """Give left, right, top and bottom (pixels) of boxes around spheres, and their centers' depth (mm)."""

    @abc.abstractmethod
    def unproject(
        self, x: Float[Array, "*points"], y: Float[Array, "*points"], depth: Float[Array, "*points"]
    ) -> Float[Array, "3 *points"]:
        """Give the point in the world at a depth under a pixel."""


def _rows(matrix: Float[Array, "3 3"], vectors: Float[Array, "3 splats"]) -> tuple[Float[Array, " splats"], ...]:
    """Multiply by a matrix, as three planes."""
    x, y, z = vectors
    return tuple(matrix[i, 0] * x + matrix[i, 1] * y + matrix[i, 2] * z for i in range(3))


_MARGIN = 8.0  # pixels around the picture; the screen filter reaches beyond a sphere
_SLOPE_FILTER = 0.25  # pixels; see _filtered
_EDGE_ON = 1e-5  # cosine to the line of sight, below which float32 does not know which side of a splat is seen


def _filtered(xx, xy, yy, root, dx, dy, vx, vy, filter_radius):
    """Widen the rim's ellipse by the screen filter: its inverse, the plane's slope, the ellipse, its determinant's root.

    The ellipse `d^T S^-1 d = 1` grows to `S + f^2 I`; `root` is that of `det S`, `(dx, dy)` is `det S slope` and `(vx, vy)` is
    `S slope`: the slope itself is infinite edge on, so a quarter of a pixel is added to `S` before it is divided by it. Hits
    stay on the plane of every splat that a pixel can resolve. No term cancels another: float32 holds however slanted the splat.
    """
    determinant, trace, fine = root * root, xx + yy, _SLOPE_FILTER**2
    slanted = determinant + fine * (trace + fine)
    slope_x, slope_y = (dx + fine * vx) / slanted, (dy + fine * vy) / slanted
    wide = filter_radius**2
    determinant = determinant + wide * (trace + wide)
    xx, yy = xx + wide, yy + wide
    return yy / determinant, -2 * xy / determinant, xx / determinant, slope_x, slope_y, xx, yy, jnp.sqrt(determinant)


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
        px, py, pz = _rows(self.rotation, (splats.centers - self.position[None]).T)
        in_sight = self._in_sight(px, py, pz, splats.radii)
        pz = jnp.where(in_sight, pz, 1.0)
        u, v, scale = px / pz, py / pz, self.focal_length / pz
        # All below is homogeneous in the normal and the radius (pixels): the normal is taken that long.
        radius = splats.radii * self.focal_length / pz
        nx, ny, nz = (n * splats.radii * self.focal_length / pz for n in _rows(self.rotation, splats.normals.T))
        facing = -(nx * u + ny * v + nz)
        visible = in_sight & (facing > _EDGE_ON * radius)
        # The disc's ellipse: S = r^2 P (I - n n^T) P^T, with P = [[1, 0, -u], [0, 1, -v]].
        an, bn = u * nx + nz, v * ny + nz
        xx = ny * ny * (1 + u * u) + an * an
        xy = u * ny * bn + v * nx * an - nx * ny
        yy = nx * nx * (1 + v * v) + bn * bn
        across, along = radius * facing, radius * radius
        dx, dy = -facing * along * nx / self.focal_length, -facing * along * ny / self.focal_length
        vx = (along * u + (nx - u * nz) * nz) / self.focal_length
        vy = (along * v + (ny - v * nz) * nz) / self.focal_length
        a, b, c, gx, gy, xx, yy, root = _filtered(xx, xy, yy, across, dx, dy, vx, vy, settings.filter_radius)
        opacity = jnp.where(visible, across / root, 0.0)
        inverse = 1 / pz
        square = inverse * inverse
        # The rim is a conic; its box is exact while the splat does not reach the plane of the pinhole.
        ux, uy = xx * gx + xy * gy, xy * gx + yy * gy
        kappa = stop_gradient(1 - (gx * ux + gy * uy))
        bounded = kappa > 1e-3
        kappa = jnp.where(bounded, kappa, 1.0)
        x, y = self.width / 2 + self.focal_length * u, self.height / 2 + self.focal_length * v
        mid_x, mid_y = stop_gradient(ux / kappa), stop_gradient(uy / kappa)
        half_x = stop_gradient(jnp.sqrt(jnp.where(bounded, (xx + ux * mid_x) / kappa, jnp.inf)))
        half_y = stop_gradient(jnp.sqrt(jnp.where(bounded, (yy + uy * mid_y) / kappa, jnp.inf)))
        cosine = facing / (radius * jnp.sqrt(1 + u * u + v * v))
        epsilon = _epsilon(splats.radii, settings.filter_radius / scale, cosine, settings)
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
        px, py, pz = _rows(self.rotation, (splats.centers - self.position[None]).T)
        nx, ny, nz = _rows(self.rotation, splats.normals.T)
        return self._in_sight(px, py, pz, splats.radii) & (nx * px + ny * py + nz * pz < 0)

    def _in_sight(self, x, y, z, radii):
        """Say which spheres touch the pyramid of the picture. Others, far to the side, are beyond what float32 projects."""

        def beside(offset, size):
            half = 0.5 * size + _MARGIN
            return jnp.abs(offset) * self.focal_length - z * half < radii * jnp.sqrt(self.focal_length**2 + half**2)

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
        column, row = self.width / 2 + self.focal_length * x / safe, self.height / 2 + self.focal_length * y / safe
        return column, row, z

    def slant(self, x, y, depth, normals):
        nx, ny, nz = jnp.tensordot(self.rotation, normals, 1)
        u, v = (x - self.width / 2) / self.focal_length, (y - self.height / 2) / self.focal_length
        mm = jnp.where(depth > self.near, depth, 1.0) / self.focal_length
        return nx * mm, ny * mm, -(nz + nx * u + ny * v)

    def pixels_per_mm(self, depth):
        return self.focal_length / jnp.maximum(depth, self.near)

    def sphere_box(self, centers, radii):
        x, y, depth = self.project(centers)
        bounded = depth > 1.01 * radii + self.near
        stretch = radii / jnp.where(bounded, depth - radii, 1.0)
        half_x = jnp.where(bounded, stretch * (self.focal_length + jnp.abs(x - self.width / 2)), jnp.inf)
        half_y = jnp.where(bounded, stretch * (self.focal_length + jnp.abs(y - self.height / 2)), jnp.inf)
        behind = depth + radii < self.near
        half_x = jnp.where(behind, -1.0, half_x)
        return x - half_x, x + half_x, y - half_y, y + half_y, depth

    def unproject(self, x, y, depth):
        u, v = (x - self.width / 2) / self.focal_length, (y - self.height / 2) / self.focal_length
        along = jnp.stack([u * depth, v * depth, depth])
        return jnp.tensordot(self.rotation.T, along, 1) + self.position.reshape(3, *[1] * depth.ndim)


class OrthographicView(AbstractView):
    """What a light at infinity sees. `position` is seen at the center of the picture, at depth 0."""

    position: Float[Array, "3"]
    rotation: Float[Array, "3 3"]
    scale: Float[Array, ""]
    """Pixels per mm."""
    width: int = eqx.field(static=True)
    height: int = eqx.field(static=True)

    def footprints(self, splats: Splats, settings: SplattingSettings) -> Footprints:
        px, py, pz = _rows(self.rotation, (splats.centers - self.position[None]).T)
        nx, ny, nz = _rows(self.rotation, splats.normals.T)
        visible = nz < -_EDGE_ON
        squared = (splats.radii * self.scale) ** 2
        xx, xy, yy = squared * (ny * ny + nz * nz), squared * (-nx * ny), squared * (nx * nx + nz * nz)
        across, along = -squared * nz, squared / self.scale
        dx, dy = across * along * nx, across * along * ny
        vx, vy = -along * nz * nx, -along * nz * ny
        a, b, c, gx, gy, xx, yy, root = _filtered(xx, xy, yy, across, dx, dy, vx, vy, settings.filter_radius)
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
            shift=stop_gradient(_epsilon(splats.radii, filter_radius, -nz, settings)),
            opacity=jnp.where(visible, across / root, 0.0),
            left=stop_gradient(x - half_x),
            right=stop_gradient(x + half_x),
            top=stop_gradient(y - half_y),
            bottom=stop_gradient(y + half_y),
            visible=visible,
        )

    def may_see(self, splats):
        x, y, _ = _rows(self.rotation, (splats.centers - self.position[None]).T)
        _, _, facing = _rows(self.rotation, splats.normals.T)
        inside_x = jnp.abs(x) < 0.5 * (self.width + 2 * _MARGIN) / self.scale + splats.radii
        return inside_x & (jnp.abs(y) < 0.5 * (self.height + 2 * _MARGIN) / self.scale + splats.radii) & (facing < 0)

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

    def pixels_per_mm(self, depth):
        return jnp.broadcast_to(self.scale, depth.shape)

    def sphere_box(self, centers, radii):
        x, y, depth = self.project(centers)
        half = radii * self.scale
        return x - half, x + half, y - half, y + half, depth

    def unproject(self, x, y, depth):
        along = jnp.stack([(x - self.width / 2) / self.scale, (y - self.height / 2) / self.scale, depth])
        return jnp.tensordot(self.rotation.T, along, 1) + self.position.reshape(3, *[1] * depth.ndim)


def _epsilon(radii, filter_radius, cosine, settings: SplattingSettings):
    """Give the depth (mm) within which fragments belong to one surface: in radii, more on slanted splats."""
    reach = jnp.sqrt(radii * radii + filter_radius * filter_radius)
    return settings.epsilon_z * reach / jnp.maximum(cosine, 1 / settings.largest_slope)
