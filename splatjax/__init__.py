"""splatjax: a differentiable renderer for translucent materials.

It renders translucent bodies from optical coefficients, and recovers coefficients from pictures.
All lengths are in millimeters. The most common names are here; the others are in submodules:

- `scattering`: media, slabs and their profiles; `transport`: the Monte Carlo reference.
- `fitting`: fits of sums of Gaussians; `gaussians`: profiles and sums of Gaussians.
- `inverse`: materials and scenes from pictures.
- `scene`: cameras, lights, materials and frames; `geometry`: bodies.
- `io`: files; `exports`: materials for other renderers.
- `splatting`, `diffusion`, `shading`: the passes, and their settings.
- `cache`: stores results and compiled programs for the next start.

`splatjax.baselines` (methods to compare with), `splatjax.plots` (which needs matplotlib) and
`splatjax.studio` (a scene that changes live) must be imported explicitly.
"""

from . import (
    cache as cache,
    diffusion as diffusion,
    exports as exports,
    fitting as fitting,
    gaussians as gaussians,
    geometry as geometry,
    inverse as inverse,
    io as io,
    scattering as scattering,
    scene as scene,
    shading as shading,
    splatting as splatting,
    transport as transport,
)
from .fitting import fit_gaussians as fit_gaussians
from .gaussians import SumOfGaussians as SumOfGaussians
from .geometry import bust as bust
from .io import (
    list_materials as list_materials,
    load_material as load_material,
    load_medium as load_medium,
    load_profile as load_profile,
    read_exr as read_exr,
    read_splats as read_splats,
    sample_mesh as sample_mesh,
    save_material as save_material,
    SplatFile as SplatFile,
    write_exr as write_exr,
    write_png as write_png,
    write_splats as write_splats,
)
from .render import (
    compute_irradiance as compute_irradiance,
    diffuse_irradiance as diffuse_irradiance,
    diffusion_basis as diffusion_basis,
    DiffusionBasis as DiffusionBasis,
    illuminate as illuminate,
    transfer as transfer,
    make_plan as make_plan,
    map_over as map_over,
    picture_jacobian as picture_jacobian,
    PictureJacobian as PictureJacobian,
    Plan as Plan,
    relighting_basis as relighting_basis,
    render as render,
    render_streamed as render_streamed,
    RenderSettings as RenderSettings,
)
from .scattering import (
    Dipole as Dipole,
    Film as Film,
    Layer as Layer,
    LayeredMultipole as LayeredMultipole,
    Medium as Medium,
    SingleScattering as SingleScattering,
)
from .scene import (
    Camera as Camera,
    DirectionalLight as DirectionalLight,
    EnvironmentLight as EnvironmentLight,
    Frame as Frame,
    GaussianBeam as GaussianBeam,
    Material as Material,
    PointLight as PointLight,
    Scene as Scene,
    Splats as Splats,
)

__version__ = "0.1.0"
