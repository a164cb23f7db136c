"""Metrics of cloth motion and folds, which a mean distance doesn't capture."""

import math

import numpy as np
import scipy.sparse as sp
from jaxtyping import Float, Int
from scipy.sparse.linalg import splu

from ..geometry import hinges, mesh_laplacian


def dihedral_angles(
    faces: Int[np.ndarray, "faces 3"], positions: Float[np.ndarray, "frames vertices 3"]
) -> Float[np.ndarray, "frames hinges"]:
    """Angle between the two triangles of every interior edge [rad].

    The sign distinguishes opposite folds of the same edge, not ridges from valleys.
    """
    a, b, left, right = hinges(faces).T
    # One component and one frame at a time, so that intermediates stay in the cache.
    out = np.empty((len(positions), len(a)))
    for k, frame in enumerate(np.asarray(positions, np.float64)):
        x = frame.T
        edge = x[:, b] - x[:, a]
        n1 = _cross(edge, x[:, left] - x[:, a])
        n2 = _cross(x[:, right] - x[:, a], edge)
        length = np.sqrt(_dot(edge, edge))
        sine = _dot(_cross(n1, n2), edge) / np.maximum(length, 1e-12)
        out[k] = np.arctan2(sine, _dot(n1, n2))
    return out


def _cross(a: Float[np.ndarray, "3 n"], b: Float[np.ndarray, "3 n"]) -> Float[np.ndarray, "3 n"]:
    return a[[1, 2, 0]] * b[[2, 0, 1]] - a[[2, 0, 1]] * b[[1, 2, 0]]


def _dot(a: Float[np.ndarray, "3 n"], b: Float[np.ndarray, "3 n"]) -> Float[np.ndarray, " n"]:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def wrinkle_error(
    faces: Int[np.ndarray, "faces 3"],
    positions: Float[np.ndarray, "frames vertices 3"],
    reference: Float[np.ndarray, "frames vertices 3"],
) -> float:
    """Root mean square difference of the dihedral angles [degrees].

    It detects wrinkles that are missing or smoothed away, whatever the mean distance.
    """
    return angle_error(dihedral_angles(faces, positions), dihedral_angles(faces, reference))


def angle_error(
    angles: Float[np.ndarray, "frames hinges"], reference: Float[np.ndarray, "frames hinges"]
) -> float:
    """`wrinkle_error` from precomputed angles [degrees]."""
    gap = (angles - reference + np.pi) % (2.0 * np.pi) - np.pi
    return float(np.degrees(np.sqrt(np.mean(gap**2))))


def fold_strength(
    faces: Int[np.ndarray, "faces 3"], positions: Float[np.ndarray, "frames vertices 3"]
) -> float:
    """Root mean square of the dihedral angles [degrees], wherever the folds are.

    `wrinkle_error` compares folds in the same places and so favours cloth without folds;
    this metric measures whether there are any.
    """
    return angle_strength(dihedral_angles(faces, positions))


def angle_strength(angles: Float[np.ndarray, "frames hinges"]) -> float:
    """`fold_strength` from precomputed angles [degrees]."""
    return float(np.degrees(np.sqrt(np.mean(angles**2))))


_OCTAVES = (0.2, 0.1, 0.05, 0.025, 0.0)
"""Bounds of the bands of `fold_spectrum`, as wavelengths [m]."""
# Times that a wave is smoothed.
_ORDER = 2


def fold_spectrum(
    rest: Float[np.ndarray, "vertices 3"],
    faces: Int[np.ndarray, "faces 3"],
    positions: Float[np.ndarray, "frames vertices 3"],
) -> Float[np.ndarray, " bands"]:
    """Mean squares of dihedral angles by the length of folds [deg^2].

    Bands are 10 to 20 cm, 5 to 10 cm, 2.5 to 5 cm, and below: of each, what the angles lose when
    waves of its shorter length are smoothed away as well. Smoothing is implicit diffusion along the
    cloth at rest, which leaves half of the power of a wave of the stated length.

    Args:
        rest: Vertices at rest [m].
        faces: Triangles.
        positions: Cloth [m].

    References:
        Desbrun et al., Implicit fairing of irregular meshes (1999).
    """
    frames, columns = len(positions), np.asarray(positions, np.float64).transpose(1, 0, 2)
    columns = columns.reshape(len(rest), -1)
    mass, stiffness = mesh_laplacian(rest, faces)
    power = []
    for wavelength in _OCTAVES:
        smooth = columns
        if wavelength:
            time = (2.0 ** (0.5 / _ORDER) - 1.0) * (wavelength / (2.0 * math.pi)) ** 2
            system = (sp.diags(mass) + time * stiffness).tocsc()
            solve = splu(system, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True}).solve
            for _ in range(_ORDER):
                smooth = solve(mass[:, None] * smooth)
        moved = smooth.reshape(len(rest), frames, 3).transpose(1, 0, 2)
        power.append(angle_strength(dihedral_angles(faces, moved)) ** 2)
    return np.maximum(np.diff(power), 1e-6)


def spectrum_distance(
    spectrum: Float[np.ndarray, " bands"], reference: Float[np.ndarray, " bands"]
) -> float:
    """Root mean square of the logarithms of two spectra's ratios [1]."""
    return float(np.sqrt(np.mean(np.log(spectrum / reference) ** 2)))


def area_strain(
    rest: Float[np.ndarray, "vertices 3"],
    faces: Int[np.ndarray, "faces 3"],
    positions: Float[np.ndarray, "frames vertices 3"],
) -> Float[np.ndarray, "frames faces"]:
    """Relative change of every triangle's area from rest [1]."""

    def area(x: np.ndarray) -> np.ndarray:
        a, b, c = (x[..., faces[:, k], :] for k in range(3))
        return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=-1)

    return area(positions) / np.maximum(area(rest), 1e-12) - 1.0


def acceleration_error(
    positions: Float[np.ndarray, "frames vertices 3"],
    reference: Float[np.ndarray, "frames vertices 3"],
    fps: float,
) -> float:
    """Mean magnitude of the acceleration difference [m/s^2]; 0 below three frames."""
    if len(positions) < 3:
        return 0.0
    gap = positions.astype(np.float64) - reference
    return float(np.linalg.norm(np.diff(gap, n=2, axis=0), axis=2).mean() * fps**2)


def jitter(positions: Float[np.ndarray, "frames vertices 3"], fps: float) -> float:
    """Mean magnitude of the jerk, the third derivative of positions [m/s^3].

    Compare it with that of the reference: a moving body always has some.

    References:
        Flash and Hogan, The coordination of arm movements (1985), for jerk as the
        measure of smoothness; TransPose (2021) for its use as jitter.
    """
    if len(positions) < 4:
        return 0.0
    third = np.diff(positions.astype(np.float64), n=3, axis=0)
    return float(np.linalg.norm(third, axis=2).mean() * fps**3)
