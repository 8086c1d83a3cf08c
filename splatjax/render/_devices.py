"""Run the passes on one device, or divide splats or pictures over the devices of a mesh; and pad
scenes so that many share a compiled program.
"""

import dataclasses
from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import PartitionSpec
from jaxtyping import Array, Float, Int, PyTree, Shaped

from splatjax._chunking import Result
from splatjax._combination import DeviceMesh, lay_out
from splatjax._records import check_class, is_traced
from splatjax.gaussians import pad_gaussians
from splatjax.scene import (
    AbstractLight,
    AbstractLightSample,
    Camera,
    Frame,
    Scene,
    Splats,
    lights_by_kind,
)

from ._checks import in_one_dtype
from ._lighting import Transfer
from ._parts import arrange, pad_splats, splats_per_device
from ._passes import Passes, SplatLight
from ._plan import Plan
from ._settings import RenderSettings

Record = TypeVar("Record", bound=eqx.Module)
Kept = TypeVar("Kept", bound=SplatLight | Transfer)


class OwnRows(NamedTuple):
    """The indices of a scene's lights and Gaussians in its padded scene."""

    lights: Int[np.ndarray, " lights"]
    gaussians: Int[np.ndarray, " gaussians"]

    def of(self, record: Record, *names: str) -> Record:
        """Remove the padding Gaussians from fields of a record."""
        padded = {name: getattr(record, name) for name in names}
        return dataclasses.replace(
            record, **jax.tree.map(lambda rows: rows_or_last(rows, self.gaussians), padded)
        )

    def frame(self, frame: Frame) -> Frame:
        """Remove the padding from a frame."""
        shown = self.of(frame, "layers", "weights", "unresolved_fraction")
        return dataclasses.replace(shown, shadow=rows_or_last(frame.shadow, self.lights))


_WITHOUT_PIXELS = "weights", "unresolved_fraction", "overflow"
_ROW_BY_ROW = "layers", "shadow"


def cut_to(camera: Camera, picture: Shaped[Array, "..."], axis: int = 0) -> Shaped[Array, "..."]:
    """Cut a picture of a padded view to that of its camera, whose rows are along an axis and whose
    columns are along the next. Compile nothing outside `jit`.
    """
    if picture.shape[axis : axis + 2] == (camera.height, camera.width):
        return picture
    part = (slice(None),) * axis + (slice(camera.height), slice(camera.width))
    return picture[part] if is_traced(picture) else jax.device_put(np.asarray(picture)[part])


def cut_frame(frame: Frame, camera: Camera) -> Frame:
    """Cut the pictures of a frame as `cut_to` does."""
    cut = {
        name: cut_to(camera, rows, axis=1 if name in _ROW_BY_ROW else 0)
        for name, rows in vars(frame).items()
        if name not in _WITHOUT_PIXELS and rows is not None
    }
    return dataclasses.replace(frame, **cut)


def pad_scene(
    scene: Scene, plan: Plan, light: Kept | None = None, camera: Camera | None = None
) -> tuple[Scene, Plan, Kept | None, OwnRows]:
    """Pad the splats of a scene to the length of its plan, the lights of each kind to four or a
    larger power of two, the Gaussians and the angles. NumPy and `device_put` are used, to compile
    nothing. If scene or camera is traced, or splats are divided over devices, nothing changes.

    The plan's order has no entry for a padding splat. A padding light has no strength and no shadow
    map; a padding Gaussian has no weight. If a light of the scene consists of several samples, or
    has no field for its strength, no light is added.

    **Arguments:**

    - `light`: a precomputed result for the scene; it is padded like the scene's lights.

    **Returns:** the scene with its lights sorted by kind, its plan, the precomputed result, and the
    indices of its own lights and Gaussians.

    **Raises:** `ValueError` for a precomputed result of other lights or another number of splats.
    """
    if light is not None:
        light = _checked(light, scene, plan)
    material = plan.diffusion.material(scene.material)
    scene = Scene(scene.splats, scene.lights, material)
    layers = len(plan.diffusion.shown(scene).material.gaussians.variances)
    own_rows = OwnRows(np.arange(len(scene.lights)), np.arange(min(plan.gaussians, layers)))
    if plan.mesh is not None or is_traced((scene, light, camera)):
        return scene, plan, light, own_rows
    splats, lights, shadows = scene.splats, scene.lights, plan.shadows
    if 0 < splats.count < len(plan.order):
        splats = jax.tree.map(lambda leaf: rows_or_last(leaf, np.arange(len(plan.order))), splats)
    if all(isinstance(light, AbstractLightSample) and light.strength_field for light in lights):
        groups = lights_by_kind(lights)
        numbered = [light for group in groups for light in group + _pad_lights(group, len(lights))]
        order = np.argsort([number for number, _ in numbered], stable=True)
        own_rows = own_rows._replace(lights=order[: len(lights)])
        lights = [light for _, light in numbered]
        shadows = tuple(
            shadow and dataclasses.replace(shadow, lights=jax.device_put(np.int32(len(group))))
            for group, shadow in zip(groups, shadows, strict=True)
        )
    gaussians = pad_gaussians(material.gaussians)
    count = len(gaussians.variances)
    if splats.weights is not None:
        weights = rows_or_last(splats.weights.swapaxes(0, 1), np.arange(count)).swapaxes(0, 1)
        splats = dataclasses.replace(splats, weights=weights)
    material = eqx.tree_at(
        lambda material: (material.gaussians, material.angles),
        material,
        (gaussians, material.angular_law()),
        is_leaf=lambda leaf: leaf is None,
    )
    plan = dataclasses.replace(plan, shadows=shadows, splats=splats.count, gaussians=count)
    scene = Scene(splats, lights, material)
    return scene, plan, light and resize_visibility(light, scene), own_rows


def _pad_lights(
    group: list[tuple[int, AbstractLightSample]], number: int
) -> list[tuple[int, AbstractLightSample]]:
    """Repeat the last light of a group with zero strength, up to four or a power of two."""
    last = group[-1][1]
    none = jax.device_put(np.zeros_like(getattr(last, last.strength_field)))
    dark = eqx.tree_at(lambda light: getattr(light, light.strength_field), last, none)
    return [(number, dark)] * ((1 << max(len(group) - 1, 2).bit_length()) - len(group))


def rows_or_last(
    rows: Shaped[Array, "rows ..."], places: Int[np.ndarray, " places"]
) -> Shaped[Array, "places ..."]:
    """Take rows; indices past the end take the last row. Compile nothing outside `jit`."""
    if np.array_equal(places, np.arange(len(rows))):
        return rows
    if is_traced(rows):
        return jnp.take(rows, places, axis=0, mode="clip")
    return jax.device_put(np.take(np.asarray(rows), places, axis=0, mode="clip"))


def resize_visibility(light: Kept, scene: Scene) -> Kept:
    """Pad or cut the rows of visibility of each kind of lights to the samples of a scene."""
    visibility = [
        rows if rows is None else rows_or_last(rows, np.arange(len(samples)))
        for rows, samples in zip(light.visibility, lights_by_kind(scene.lights), strict=True)
    ]
    return dataclasses.replace(light, visibility=visibility)


_PLACES = "direction", "directions", "position", "center"


def places_of(lights: Sequence[AbstractLight]) -> tuple[dict[str, Array], ...]:
    """Return the directions and positions of the lights that cast shadows."""
    casting = [light for light in lights if getattr(light, "cast_shadows", True)]
    fields = [{name: getattr(light, name, None) for name in _PLACES} for light in casting]
    return tuple({k: v for k, v in places.items() if v is not None} for places in fields)


def _are_close(*trees: PyTree) -> bool:
    leaves, structures = zip(*map(jax.tree.flatten, trees), strict=True)
    return structures[0] == structures[1] and all(map(partial(np.allclose, atol=1e-5), *leaves))


def _checked(light: Kept, scene: Scene, plan: Plan) -> Kept:
    """Return a precomputed result without the places of its lights.

    **Raises:** `ValueError` for other lights or another number of splats.
    """
    check_class("light", light, SplatLight, Transfer)
    groups = jax.eval_shape(
        lambda lights: [[sample for _, sample in group] for group in lights_by_kind(lights)],
        scene.lights,
    )
    shapes = [(len(g), len(plan.order)) if g[0].cast_shadows else None for g in groups]
    kept = [rows if rows is None else rows.shape for rows in light.visibility]
    if kept != shapes:
        raise ValueError(
            f"light has visibility {kept} (samples of each kind of lights, splats), and the "
            f"scene with its plan has {shapes}; compute it again with lights of these kinds"
        )
    if not isinstance(light, Transfer):
        return light
    pair = light.places, places_of(scene.lights)
    if light.places and not is_traced(pair) and not _are_close(*pair):
        raise ValueError(
            "light was computed for lights in other directions or at other positions; compute it "
            "again, or give an EnvironmentLight fixed `directions`"
        )
    return dataclasses.replace(light, places=())


def on_devices(
    function: Callable[..., Result],
    scene: Scene,
    settings: RenderSettings,
    plan: Plan,
    *replicated: PyTree,
    rows: tuple[PyTree[Float[Array, "splats ..."]], ...] = (),
    placed: PyTree = None,
    by_splat: bool = False,
) -> Result:
    """Run a function on every device of a plan, with the splats of that device in the plan's order
    and in the precision of their centers. Gradients stay on the devices of the splats.

    **Arguments:**

    - `function`: takes the device's passes, then `replicated`, `rows` and, if given, `placed`.
    - `replicated`: the same on every device.
    - `rows`: one row per splat, in the order of the scene.
    - `placed`: results of an earlier call, one entry per splat in the order of the plan.
    - `by_splat`: whether results have one entry per splat, in the order of the plan; otherwise
      they are the same on all devices.
    """
    scene, replicated, rows = in_one_dtype(scene, replicated, rows)
    devices, per_device = splats_per_device(scene.splats.count, plan.mesh)
    count = devices * per_device
    splats = pad_splats(scene.splats, count)
    rows = jax.tree.map(lambda row: jnp.pad(row, ((0, count - len(row)), (0, 0))), rows)
    extra = () if placed is None else (placed,)

    def run(combination: DeviceMesh, splats: Splats, lit, plan: Plan, replicated, rows, extra):
        scene = Scene(arrange(splats, plan.order, plan.exists), *lit)
        rows = jax.tree.map(lambda row: row[plan.order], rows)
        return function(Passes(scene, settings, plan, combination), *replicated, *rows, *extra)

    arguments = splats, (scene.lights, scene.material), plan, replicated, rows, extra
    if plan.mesh is None:
        return run(DeviceMesh(), *arguments)
    mesh = DeviceMesh.of(plan.mesh)
    specs = (
        mesh.shares,
        PartitionSpec(),
        plan.specs(mesh),
        PartitionSpec(),
        mesh.shares,
        along_splats(extra, mesh),
    )
    out_specs = PartitionSpec()
    if by_splat:
        shapes = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype), arguments)
        results = jax.eval_shape(lambda arguments: run(DeviceMesh(), *arguments), shapes)
        out_specs = along_splats(results, mesh)
    # The check of varying axes is off: custom derivatives and loops have no rules for it.
    mapped = jax.shard_map(
        lambda *shares: run(mesh, *shares),
        mesh=plan.mesh,
        in_specs=specs,
        out_specs=out_specs,
        check_vma=False,
    )
    return mapped(*lay_out(plan.mesh, arguments, specs))


def along_splats(tree: PyTree, devices: DeviceMesh) -> PyTree:
    """Specify that arrays are divided along their last axis, and that numbers are replicated."""
    return jax.tree.map(
        lambda leaf: (
            PartitionSpec(*[None] * (leaf.ndim - 1), devices.axes) if leaf.ndim else PartitionSpec()
        ),
        tree,
    )
