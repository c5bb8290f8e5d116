"""High dynamic range to the 8-bit colors of the web: films in HLG (phones) or PQ, with BT.2020 primaries.

Transfer functions: ITU-R BT.2100. A display of the web shows HDR's reference white at full level: brighter light is
rolled off by a curve that keeps what is below three quarters of it.
"""

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from lapgs_wgpu.data.images import Pixels

Transfer = Literal["HLG", "PQ"]
TRANSFERS: dict[int, Transfer] = {18: "HLG", 16: "PQ"}  # by their numbers in ISO/IEC 23091-2

REFERENCE_WHITE = 203.0  # cd/m2, ITU-R BT.2408
PEAK = 1000.0  # cd/m2 of the display for which HLG is shown
KNEE = 0.75  # of the reference white: above it light is rolled off
TO_BT709 = np.array([[1.6605, -0.5876, -0.0728], [-0.1246, 1.1329, -0.0083], [-0.0182, -0.1006, 1.1187]], np.float32)
LUMINANCE = np.array([0.2627, 0.6780, 0.0593], np.float32)  # of BT.2020's red, green, blue


def to_sdr(image: NDArray[np.uint16], transfer: Transfer) -> Pixels:
    """(H, W, 3) uint16 R'G'B' of BT.2100 -> (H, W, 3) uint8 sRGB."""
    signal = np.linspace(0, 1, 4096)  # 12 bits, more than films have
    if transfer == "HLG":  # relative light of the scene, by whose brightness the display changes it
        a, b, c = 0.17883277, 0.28466892, 0.55991073
        table = np.where(signal <= 0.5, signal**2 / 3, (np.exp((signal - c) / a) + b) / 12)
        light = table.astype(np.float32)[image >> 4]
        light *= (PEAK / REFERENCE_WHITE) * np.maximum(light @ LUMINANCE, 1e-6)[..., None] ** np.float32(0.2)
    else:  # light of the display
        m1, m2, c1, c2, c3 = 0.1593017578125, 78.84375, 0.8359375, 18.8515625, 18.6875
        root = signal ** (1 / m2)
        table = 10000 / REFERENCE_WHITE * (np.maximum(root - c1, 0) / (c2 - c3 * root)) ** (1 / m1)
        light = table.astype(np.float32)[image >> 4]
    light = np.clip(light @ TO_BT709.T, 0, None)
    strongest = light.max(axis=2, keepdims=True)
    above = np.maximum(strongest - KNEE, 0) / (1 - KNEE)  # is bent, with the same slope at the knee
    rolled_off = np.where(strongest <= KNEE, strongest, KNEE + (1 - KNEE) * above / (1 + above)).astype(np.float32)
    light *= rolled_off / np.maximum(strongest, 1e-6)  # of all channels alike, which keeps the hue
    shown = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    return np.floor(np.clip(shown, 0, 1) * 255 + 0.5).astype(np.uint8)
