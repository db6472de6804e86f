"""The measured spectra of the Cornell box, and the way from a spectrum to linear sRGB."""

from __future__ import annotations

import numpy as np

# Cornell University Program of Computer Graphics, "Cornell Box Data": reflectance in thousandths, 400 to 700 nm in
# steps of 4 nm.
WHITE = """
343 445 551 624 665 687 708 723 715 710 745 758 739 767 777 765 751 745 748 729 745 757 753 750 746 747 735 732 739 734
725 721 733 725 732 743 744 748 728 716 733 726 713 740 754 764 752 736 734 741 740 732 745 755 751 744 731 733 744 731
712 708 729 730 727 707 703 729 750 760 751 739 724 730 740 737"""
GREEN = """
092 096 098 097 098 095 095 097 095 094 097 098 096 101 103 104 107 109 112 115 125 140 160 187 229 285 343 390 435 464
472 476 481 462 447 441 426 406 373 347 337 314 285 277 266 250 230 207 186 171 160 148 141 136 130 126 123 121 122 119
114 115 117 117 118 120 122 128 132 139 144 146 150 152 157 159"""
RED = """
040 046 048 053 049 050 053 055 057 056 059 057 061 061 060 062 062 062 061 062 060 059 057 058 058 058 056 055 056 059
057 055 059 059 058 059 061 061 063 063 067 068 072 080 090 099 124 154 192 255 287 349 402 443 487 513 558 584 620 606
609 651 612 610 650 638 627 620 630 628 642 639 657 639 635 642"""
MEASURED = np.arange(400.0, 701.0, 4.0)  # wavelengths of the tables [nm]
LIGHT = ((400.0, 500.0, 600.0, 700.0), (0.0, 8.0, 15.6, 18.4))  # the lamp: wavelength [nm], emission

WAVELENGTHS = np.arange(400.0, 701.0, 1.0)
# CIE XYZ to linear sRGB, IEC 61966-2-1.
XYZ_TO_RGB = np.array(
    [[3.2404542, -1.5371385, -0.4985314], [-0.9692660, 1.8760108, 0.0415560], [0.0556434, -0.2040259, 1.0572252]]
)


def colour_matching(wavelength: np.ndarray) -> np.ndarray:
    """CIE 1931 2-degree matching functions by the multi-lobe fit of Wyman, Sloan, Shirley 2013, eq. 4.

    Args:
        wavelength: nm, shape (N,).

    Returns:
        x, y, z, shape (N, 3).
    """

    def lobe(height: float, mean: float, below: float, above: float) -> np.ndarray:
        t = (wavelength - mean) * np.where(wavelength < mean, below, above)
        return height * np.exp(-0.5 * t * t)

    x = lobe(0.362, 442.0, 0.0624, 0.0374) + lobe(1.056, 599.8, 0.0264, 0.0323) - lobe(0.065, 501.1, 0.0490, 0.0382)
    y = lobe(0.821, 568.8, 0.0213, 0.0247) + lobe(0.286, 530.9, 0.0613, 0.0322)
    z = lobe(1.217, 437.0, 0.0845, 0.0278) + lobe(0.681, 459.0, 0.0385, 0.0725)
    return np.stack([x, y, z], axis=1)


def spectrum_to_rgb(spectrum: np.ndarray) -> np.ndarray:
    """Linear sRGB of a spectrum at `WAVELENGTHS`, scaled so that the constant spectrum 1 is (1, 1, 1); shape (3,).

    That puts the picture's white at equal energy; without it a lamp as warm as Cornell's would look redder still.
    """
    to_rgb = colour_matching(WAVELENGTHS) @ XYZ_TO_RGB.T
    return spectrum @ to_rgb / to_rgb.sum(axis=0)


def lamp_rgb() -> tuple[float, float, float]:
    """Radiance of the Cornell lamp, linear sRGB."""
    return tuple(spectrum_to_rgb(np.interp(WAVELENGTHS, *LIGHT)).tolist())


def reflectance_rgb(table: str) -> tuple[float, float, float]:
    """Reflectance of a measured table for a renderer that multiplies RGB: light once reflected has the right colour.

    It is the sRGB of lamp times reflectance over the sRGB of the lamp, channel by channel, so a grey paint stays grey
    and direct light is exact; light reflected twice is not, as in every renderer of three channels.
    """
    measured = np.array(table.split(), dtype=np.float64) / 1000.0
    lamp = np.interp(WAVELENGTHS, *LIGHT)
    reflected = lamp * np.interp(WAVELENGTHS, MEASURED, measured)
    return tuple((spectrum_to_rgb(reflected) / spectrum_to_rgb(lamp)).tolist())
