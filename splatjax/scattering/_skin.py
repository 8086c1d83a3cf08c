"""Optical properties of skin, computed from its pigments: coefficients by wavelength, reflectance
and profile.

Columns of the table of absorption, from 380 to 780 nm in steps of 5 nm:

- Oxyhemoglobin and deoxyhemoglobin, molar extinction, 1/(cm mol/l): S. Prahl, "Tabulated molar
  extinction coefficient for hemoglobin in water" (omlc.org/spectra/hemoglobin), from data of
  Gratzer and Kollias; from 450 nm on the same as in the package SIMPA (MIT).
- Water, absorption coefficient, 1/cm: Segelstein 1981, "The complex refractive index of water".
- Beta-carotene in hexane and bilirubin in chloroform, molar extinction, 1/(cm mol/l): PhotochemCAD
  (Du et al. 1998; Dixon, Taniguchi and Lindsey 2005), edited by S. Prahl; means over 2 nm. Beyond
  525 nm the values are below the noise of the measurement and are set to 0.

The numbers are measurements, published for use with citation. Melanins follow power laws.
"""

from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from splatjax._chunking import jit_unless_traced
from splatjax._records import check_values, numbers, record, require, valid
from splatjax._smooth import mean_decay
from splatjax.gaussians import AbstractProfile

from ._half_space import HalfSpace
from ._medium import Layer, Medium
from ._photon_beam import PhotonBeam

_SHORTEST, _LONGEST = 380.0, 780.0  # nm
# Molar masses, g/mol, and grams of hemoglobin in a liter of blood (Prahl).
_HEMOGLOBIN, _CAROTENE, _BILIRUBIN, _IN_BLOOD = 64500.0, 536.87, 584.66, 150.0
_PER_MM = np.log(10) / 10  # from decadic extinction per cm to absorption per mm

_MEASURED = np.array(
    [
        (109564, 145232, 0.000641, 30500, 11615),
        (130276, 151288, 0.000601, 35004, 13791),
        (167748, 167780, 0.000568, 41900, 16382),
        (221836, 196832, 0.000529, 50151, 19584),
        (266232, 223296, 0.000496, 58900, 23212),
        (331462, 261958, 0.000462, 66126, 26884),
        (466840, 303956, 0.000436, 73202, 30863),
        (523080, 353222, 0.000405, 82223, 34925),
        (480360, 407560, 0.000377, 97374, 39311),
        (351134, 471520, 0.000346, 105923, 43447),
        (246072, 528600, 0.000314, 107000, 46825),
        (149076, 549600, 0.000294, 111436, 49731),
        (102580, 413280, 0.000269, 120966, 52050),
        (78884, 259974, 0.000245, 132086, 53601),
        (62816, 103292, 0.000226, 138730, 54790),
        (51524, 33434, 0.000215, 133122, 54883),
        (44480, 23389, 0.000207, 121173, 53900),
        (38440, 18702, 0.000203, 110148, 51079),
        (33209, 16156, 0.000195, 108427, 46077),
        (29482, 14921, 0.000185, 112395, 38746),
        (26629, 14550, 0.000186, 110400, 29682),
        (24925, 15378, 0.000185, 96757, 21293),
        (23684, 16684, 0.000188, 76107, 14055),
        (22154, 18648, 0.000199, 52736, 8641),
        (20933, 20862, 0.000232, 32662, 4755),
        (20182, 23289, 0.000268, 19186, 2474),
        (20035, 25774, 0.000312, 10985, 1298),
        (20715, 28682, 0.000356, 6539, 658),
        (24202, 31590, 0.000379, 3386, 345),
        (30883, 35171, 0.000393, 2026, 193),
        (39957, 39036, 0.000417, 0, 0),
        (48338, 42840, 0.000444, 0, 0),
        (53236, 46592, 0.000489, 0, 0),
        (50982, 50488, 0.000524, 0, 0),
        (43016, 53412, 0.000558, 0, 0),
        (35646, 54530, 0.000602, 0, 0),
        (32613, 53788, 0.000644, 0, 0),
        (35205, 49700, 0.000697, 0, 0),
        (44496, 45072, 0.000757, 0, 0),
        (54424, 40904, 0.000839, 0, 0),
        (50104, 37020, 0.000988, 0, 0),
        (30620, 33592, 0.00112, 0, 0),
        (14401, 28324, 0.00136, 0, 0),
        (6681, 21187, 0.00158, 0, 0),
        (3200, 14677, 0.00202, 0, 0),
        (1959, 12040, 0.00235, 0, 0),
        (1506, 9444, 0.00255, 0, 0),
        (1166, 7553, 0.00272, 0, 0),
        (942, 6510, 0.00286, 0, 0),
        (741, 5763, 0.00296, 0, 0),
        (610, 5149, 0.00301, 0, 0),
        (496, 4667, 0.00307, 0, 0),
        (442, 4345, 0.00308, 0, 0),
        (398, 4027, 0.00312, 0, 0),
        (368, 3750, 0.00324, 0, 0),
        (340, 3481, 0.00341, 0, 0),
        (320, 3227, 0.00364, 0, 0),
        (306, 3011, 0.00384, 0, 0),
        (294, 2795, 0.00394, 0, 0),
        (284, 2591, 0.00406, 0, 0),
        (278, 2408, 0.00421, 0, 0),
        (274, 2225, 0.00453, 0, 0),
        (276, 2052, 0.00483, 0, 0),
        (281, 1923, 0.00536, 0, 0),
        (290, 1794, 0.00601, 0, 0),
        (300, 1661, 0.00731, 0, 0),
        (314, 1540, 0.00885, 0, 0),
        (329, 1433, 0.0105, 0, 0),
        (348, 1326, 0.0134, 0, 0),
        (368, 1224, 0.0166, 0, 0),
        (390, 1102, 0.0204, 0, 0),
        (413, 1102, 0.0231, 0, 0),
        (446, 1116, 0.0248, 0, 0),
        (480, 1237, 0.0258, 0, 0),
        (518, 1405, 0.0261, 0, 0),
        (555, 1551, 0.0263, 0, 0),
        (586, 1549, 0.0261, 0, 0),
        (616, 1435, 0.0258, 0, 0),
        (650, 1312, 0.0248, 0, 0),
        (683, 1188, 0.024, 0, 0),
        (710, 1075, 0.0227, 0, 0),
    ]
)
_OF_BLOOD = _PER_MM * _IN_BLOOD / _HEMOGLOBIN
_TABLE = _MEASURED * [_OF_BLOOD, _OF_BLOOD, 0.1, _PER_MM / _CAROTENE, _PER_MM / _BILIRUBIN]
_COLUMNS = ("oxygenated", "deoxygenated", "water", "carotene", "bilirubin")


def _pigment_absorption(
    wavelengths: Float[Array, " channels"],
) -> dict[str, Float[Array, " channels"]]:
    r"""Compute absorption coefficients, 1/mm, at wavelengths in nm, by linear interpolation of the
    table. They are for whole blood with fully `oxygenated` or `deoxygenated` hemoglobin, `water`, 1
    g/l of `carotene` and of `bilirubin`, pure `eumelanin` and `pheomelanin`, and bloodless tissue
    without pigment (`baseline`).

    **Source:** blood with 150 g/l of hemoglobin: Prahl; melanins: Donner and Jensen 2006 (after
    Jacques), `6.6e10 l^-3.33` and `2.9e14 l^-4.75`; baseline: Donner and Jensen 2006
    (after Jacques), `0.0244 + 8.53 exp(-(l - 154) / 66.2)`.
    """
    steps = jnp.linspace(_SHORTEST, _LONGEST, len(_TABLE)).astype(wavelengths.dtype)
    measured = {
        name: jnp.interp(wavelengths, steps, jnp.asarray(column, wavelengths.dtype))
        for name, column in zip(_COLUMNS, _TABLE.T, strict=True)
    }
    return measured | {
        "eumelanin": 6.6e10 * wavelengths**-3.33,
        "pheomelanin": 2.9e14 * wavelengths**-4.75,
        "baseline": 0.0244 + 8.53 * jnp.exp((154 - wavelengths) / 66.2),
    }


def _between(least: float, most: float, unit: str = "") -> dict[str, Any]:
    return valid(f"between {least:g} and {most:g}{unit}", lambda x: (x >= least) & (x <= most))


@record
class Skin(eqx.Module):
    r"""Skin, modeled by wavelength as a thin epidermis with melanin on a deep dermis with blood.

    The absorption of a layer is the sum over its contents; the remainder is bloodless tissue. Both
    layers have the reduced scattering coefficient `scattering * (l / 500 nm)^-scattering_power` at
    the wavelength `l`. All parameters except the wavelengths are differentiable numbers; use
    `jax.vmap` for many skins.

    **Attributes:**

    - `melanin`: volume fraction of melanosomes in the epidermis: 0.01 to 0.06 in light skin, 0.1 to
      0.4 in dark skin.
    - `blood`: volume fraction of blood in the dermis, averaged over depth; 0.005 to 0.015 fit
      measured skin.
    - `oxygenation`: fraction of the hemoglobin that carries oxygen: 0.52 to 0.67 on forehead,
      forearm, back of the hand, trunk and legs; 0.9 at the tips of fingers and toes.
    - `eumelanin`: fraction of the melanin that is eumelanin; the rest is pheomelanin.
    - `carotene`, `bilirubin`: g/l; carotene is in both layers, bilirubin in the dermis.
    - `water`: volume fraction of water in both layers.
    - `vessel_radius`: mm. Blood in a vessel shadows itself, which flattens its absorption bands.
    - `thickness`: thickness of the epidermis, mm; it may be thinner than a mean free path.
    - `scattering`: reduced scattering coefficient at 500 nm, 1/mm; `scattering_power`: the exponent
      of its decrease with the wavelength.
    - `eta`: index of refraction of the surface, through which light leaves (that of the tissue
      below is 1.4); `g`: mean cosine of the phase function.
    - `wavelengths`: the channels, nm; by default 400 to 700 in steps of 10.

    **Raises:** `ValueError` for a value out of its range, for water and blood that exceed 1
    together, and without wavelengths.

    **Source:** two layers, melanins and baseline: Donner and Jensen 2006; scattering of skin, a
    mean over published measurements: Jacques 2013; eumelanin's share: Del Bino et al. 2015;
    vessels: Van Veen, Verkruysse and Sterenborg 2002; oxygenation, 52 to 67% at
    six places: "Quantitative reflection spectrophotometry" (Int. J. Microcirc. 15(3), 131); index,
    1.51 to 1.53 on cheeks at 550 nm: Yoshida et al. 2013 (J. Biomed. Opt. 18(3), 037002).
    """

    melanin: Float[Array, ""] = eqx.field(
        converter=numbers, default=0.02, metadata=_between(0.0, 1.0)
    )
    blood: Float[Array, ""] = eqx.field(
        converter=numbers, default=0.01, metadata=_between(0.0, 1.0)
    )
    oxygenation: Float[Array, ""] = eqx.field(
        converter=numbers, default=0.6, metadata=_between(0.0, 1.0)
    )
    eumelanin: Float[Array, ""] = eqx.field(
        converter=numbers, default=0.74, metadata=_between(0.0, 1.0)
    )
    carotene: Float[Array, ""] = eqx.field(
        converter=numbers, default=7e-5, metadata=_between(0.0, 0.1, " (g/l)")
    )
    bilirubin: Float[Array, ""] = eqx.field(
        converter=numbers, default=0.0, metadata=_between(0.0, 1.0, " (g/l)")
    )
    water: Float[Array, ""] = eqx.field(
        converter=numbers, default=0.65, metadata=_between(0.0, 1.0)
    )
    vessel_radius: Float[Array, ""] = eqx.field(
        converter=numbers, default=0.02, metadata=_between(0.0, 1.0, " (mm)")
    )
    thickness: Float[Array, ""] = eqx.field(
        converter=numbers, default=0.08, metadata=_between(0.0, 2.0, " (mm)")
    )
    scattering: Float[Array, ""] = eqx.field(
        converter=numbers, default=4.6, metadata=_between(0.1, 100.0, " (1/mm)")
    )
    scattering_power: Float[Array, ""] = eqx.field(
        converter=numbers, default=1.421, metadata=_between(0.0, 4.0)
    )
    eta: Float[Array, ""] = eqx.field(converter=numbers, default=1.5, metadata=_between(1.0, 3.0))
    g: Float[Array, ""] = eqx.field(converter=numbers, default=0.8, metadata=_between(-0.95, 0.95))
    wavelengths: Float[Array, " channels"] = eqx.field(
        converter=numbers,
        default=tuple(range(400, 701, 10)),
        metadata=valid("between 380 and 780 (nm)", lambda x: (x >= _SHORTEST) & (x <= _LONGEST)),
    )

    def __check_init__(self):
        check_values(
            "Skin.water and blood together",
            self.water + self.blood,
            "at most 1",
            lambda x: x < 1 + 1e-6,
        )
        require(
            np.shape(self.wavelengths) != (0,),
            "Skin.wavelengths is empty; give one wavelength (nm) or more",
        )

    @jit_unless_traced
    def media(self) -> tuple[Medium, Medium]:
        """Compute the coefficients of epidermis and dermis."""
        pure = _pigment_absorption(self.wavelengths)
        melanin = self.eumelanin * pure["eumelanin"] + (1 - self.eumelanin) * pure["pheomelanin"]
        blood = pure["deoxygenated"] + self.oxygenation * (
            pure["oxygenated"] - pure["deoxygenated"]
        )
        water_and_carotene = self.water * pure["water"] + self.carotene * pure["carotene"]
        epidermis = self.melanin * melanin + (1 - self.melanin) * pure["baseline"]
        blood = blood * mean_decay(2 * self.vessel_radius * blood)
        dermis = self.blood * blood + (1 - self.blood) * pure["baseline"]
        sigma_s_prime = self.scattering * (self.wavelengths / 500) ** -self.scattering_power
        eta = jnp.broadcast_to(self.eta, sigma_s_prime.shape)
        bilirubin = self.bilirubin * pure["bilirubin"]
        return (
            Medium(epidermis + water_and_carotene, sigma_s_prime, eta),
            Medium(dermis + water_and_carotene + bilirubin, sigma_s_prime, eta),
        )

    def layers(self) -> tuple[Layer, Layer]:
        """Return epidermis and dermis as layers, for `transport.monte_carlo`."""
        epidermis, dermis = self.media()
        return Layer(epidermis, self.thickness), Layer(dermis, jnp.inf)

    def half_space(self) -> HalfSpace:
        """Return the dermis with the epidermis as its cover, for total reflectance, color and
        angular law by light transport.
        """
        epidermis, dermis = self.layers()
        return HalfSpace(dermis.medium, jnp.full_like(self.wavelengths, self.g), epidermis)

    def profile(self) -> "SkinProfile":
        """Compute the profile for light along the normal; its total is that of light transport."""
        (epidermis, dermis), whole = self.media(), self.half_space()
        black = Medium(1e6 * dermis.sigma_s_prime, dermis.sigma_s_prime, dermis.eta)
        shallow = HalfSpace(black, whole.g, whole.cover).total_reflectance()
        return SkinProfile(dermis, whole.total_reflectance() - shallow, epidermis, shallow)


@record
class SkinProfile(AbstractProfile):
    r"""The profile of a dermis under a thin epidermis. The reflectances of the epidermis alone and
    of the dermis below it are photon beam profiles, each scaled to its total.

    The epidermis only attenuates the light of the dermis; `Skin.profile` computes both totals by
    light transport. The profile diverges like 1/r at the origin.

    Errors against Monte Carlo with `g=0`, in rings 0.1 to 1 mm wide: for `melanin=0.02`, at most 8%
    up to 3 mm at 620 nm and 12% up to 1.5 mm at 450 nm; farther out, where 2% of the light leaves,
    the profile is up to 50% too large. For `melanin=0.3` at 620 nm, at most 33% up to 2 mm; farther
    out, where an eighth of the light leaves, it is up to 70% too large. With the default `g=0.8`
    the total is as accurate, but the profile uses reduced scattering: it is 20 to 70% too large up
    to 0.1 mm from the point of entry, and 10 to 35% too small from 0.2 to 0.75 mm.

    **Attributes:** (differentiable)

    - `dermis`, `epidermis`: their coefficients.
    - `deep`, `shallow`: the total reflectance of the dermis and of the epidermis, [channels].
    """

    dermis: Medium
    deep: Float[Array, " channels"] = eqx.field(converter=numbers)
    epidermis: Medium
    shallow: Float[Array, " channels"] = eqx.field(converter=numbers)

    singular: ClassVar[bool] = True
    has_separate_channels: ClassVar[bool] = True

    @jit_unless_traced
    def evaluate(self, r: Float[Array, "*radii"]) -> Float[Array, "*radii channels"]:
        def scaled(medium: Medium, total: Float[Array, " channels"]):
            beam = PhotonBeam(medium)
            values = beam(r)
            return values * jnp.broadcast_to(total / beam.total_reflectance(), values.shape)

        return scaled(self.dermis, self.deep) + scaled(self.epidermis, self.shallow)

    def total_reflectance(self) -> Float[Array, " channels"]:
        return self.deep + self.shallow

    def length_scale(self) -> Float[Array, " channels"]:
        return PhotonBeam(self.dermis).length_scale()
