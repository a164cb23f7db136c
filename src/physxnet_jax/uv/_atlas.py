"""The atlas: the body's uv chart without face, hands and feet, stretched to the square."""

import dataclasses
import functools
import hashlib

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..body import NUM_BODY_VERTICES, Body, load_body
from ..geometry import connected_components
from ..typing import pytree
from ._rasterise import rasterise
from ._skirt import SkirtChart, make_skirt_chart
from ._transference import Transference

_EXCLUDED_JOINTS = (
    ("Head", "Neck1"),
    ("LeftHand", "LThumb", "LeftFingerBase", "LeftHandFinger1"),
    ("RightHand", "RThumb", "RightFingerBase", "RightHandFinger1"),
    ("LeftFoot", "LeftToeBase"),
    ("RightFoot", "RightToeBase"),
)
# Share of the height over which the chart's outline is smoothed before stretching.
_SMOOTH = 0.05


@pytree
@dataclasses.dataclass(frozen=True)
class Atlas:
    """Texels of the clothed part of the body.

    Attributes:
        texels: Covered texels in row-major order as flat indices, shape [texels].
        to_body: T_UB, body vertices to the texels of the body's chart, rows as the first of
            ``texels``.
        uv: Texture coordinates in the atlas, shape [uvs, 2].
        faces: Body faces in the chart, vertex indices, shape [faces, 3].
        uv_faces: Their corners in ``uv``, shape [faces, 3].
        height: Rows of a map, including those of the skirt's chart.
        width: Columns of a map.
        used_before: Share of texels that the clothed part covers in the original chart.
        skirt: The chart of skirts, in the lowest rows; None without one.
    """

    texels: Int[Array, " texels"]
    to_body: Transference
    uv: Float[Array, "uvs 2"]
    faces: Int[Array, "faces 3"]
    uv_faces: Int[Array, "faces 3"]
    height: int = dataclasses.field(metadata={"static": True})
    width: int = dataclasses.field(metadata={"static": True})
    used_before: float = dataclasses.field(metadata={"static": True})
    skirt: SkirtChart | None = None

    @property
    def body_rows(self) -> int:
        """Rows of the body's chart."""
        return self.height - (0 if self.skirt is None else self.skirt.rows)

    @property
    def num_body_texels(self) -> int:
        """Number of covered texels of the body's chart."""
        return self.to_body.shape[0]

    @property
    def num_texels(self) -> int:
        """Number of covered texels."""
        return self.texels.shape[0]

    @property
    def used(self) -> float:
        """Share of the texels of the body's chart that are covered."""
        return self.num_body_texels / (self.body_rows * self.width)

    @property
    def mask(self) -> Bool[Array, "height width"]:
        """Which texels are covered."""
        flat = jnp.zeros((self.height * self.width,), bool).at[self.texels].set(True)
        return flat.reshape(self.height, self.width)

    def at_texels(
        self, values: Float[Array, "*batch vertices channels"]
    ) -> Float[Array, "*batch texels channels"]:
        """Values of body vertices at all covered texels."""
        own = self.to_body @ values
        return own if self.skirt is None else jnp.concatenate([own, self.skirt @ values], axis=-2)

    def to_map(
        self, values: Float[Array, "*batch texels channels"]
    ) -> Float[Array, "*batch height width channels"]:
        """Values of covered texels as maps, zero elsewhere."""
        *batch, _, channels = values.shape
        flat = jnp.zeros((*batch, self.height * self.width, channels), values.dtype)
        flat = flat.at[..., self.texels, :].set(values, unique_indices=True)
        return flat.reshape(*batch, self.height, self.width, channels)

    def from_map(
        self, maps: Float[Array, "*batch height width channels"]
    ) -> Float[Array, "*batch texels channels"]:
        """Values of the covered texels of maps."""
        *batch, height, width, channels = maps.shape
        return maps.reshape(*batch, height * width, channels)[..., self.texels, :]

    def digest(self) -> str:
        """A hash of the texels and their body points; network weights are tied to it."""
        h = hashlib.sha256(f"{self.height}x{self.width}".encode())
        h.update(np.asarray(self.texels).tobytes())
        h.update(np.asarray(self.to_body.vertices).tobytes())
        # Weights are rounded: compilers may differ in the last bits.
        h.update(np.round(np.asarray(self.to_body.weights), 3).astype(np.float32).tobytes())
        if self.skirt is not None:
            h.update(np.asarray(self.skirt.left.vertices).tobytes())
        return h.hexdigest()[:16]


def make_atlas(
    resolution: int | tuple[int, int] = 256, body: Body | None = None, *, skirt: bool = False
) -> Atlas:
    """Builds the atlas at a resolution.

    The chart of the torso and limbs is cropped to its bounding box. Its rows are then
    stretched towards the sides of the square, according to its smoothed outline.

    Args:
        resolution: Texels per side, or (height, width).
        body: The body; the built-in one by default.
        skirt: Append a chart for skirts, half as high as the body's.

    Returns:
        The atlas. ``used_before`` and ``used`` give the coverage before and after stretching.

    Note (differs from the paper):
        The paper has no chart for skirts: there, a dress samples the charts of both legs, which
        don't meet.

    References:
        PhysXNet, section 4.2: face, hands and feet are removed, limbs stretched.
    """
    size = (resolution, resolution) if isinstance(resolution, int) else resolution
    if body is None or body is load_body():
        return _cached_atlas(*size, skirt)
    return _make_atlas(size, body, skirt)


@functools.cache
def _cached_atlas(height: int, width: int, skirt: bool) -> Atlas:
    # Cached arrays mustn't be tracers of an enclosing transformation.
    with jax.ensure_compile_time_eval():
        return _make_atlas((height, width), load_body(), skirt)


def _make_atlas(size: tuple[int, int], body: Body, skirt: bool) -> Atlas:
    height, width = size
    mesh = body.rest_mesh()
    faces, uv_faces = np.asarray(mesh.faces), np.asarray(mesh.uv_faces)
    uv = np.asarray(mesh.uv, dtype=np.float64)
    weights = np.asarray(body.weights)[:NUM_BODY_VERTICES]
    excluded_weight = np.stack(
        [weights[:, [body.joint(n) for n in names]].sum(axis=1) for names in _EXCLUDED_JOINTS]
    ).max(axis=0)
    keep = excluded_weight[faces].mean(axis=1) <= 0.5
    # One chart holds the torso and limbs; fragments of others are dropped.
    chart = connected_components(uv_faces, len(uv))[uv_faces[:, 0]]
    keep &= chart == np.bincount(chart[keep]).argmax()
    faces, uv_faces = faces[keep], uv_faces[keep]
    before = len(rasterise(uv, uv_faces, height, width)[0]) / (height * width)
    stretched = _stretch(uv, uv_faces)
    texels, own, bary = rasterise(stretched, uv_faces, height, width)
    transference = Transference(
        jax.device_put(faces[own].astype(np.int32)),
        jax.device_put(bary.astype(np.float32)),
        jnp.ones((len(own),), bool),
        NUM_BODY_VERTICES,
    )
    skirt_chart = make_skirt_chart(body, height // 2, width) if skirt else None
    if skirt_chart is not None:
        below = height * width + np.arange(skirt_chart.rows * width)
        texels = np.concatenate([texels, below]).astype(np.int32)
    return Atlas(
        jax.device_put(texels),
        transference,
        jax.device_put(stretched.astype(np.float32)),
        jax.device_put(faces.astype(np.int32)),
        jax.device_put(uv_faces.astype(np.int32)),
        height + (0 if skirt_chart is None else skirt_chart.rows),
        width,
        before,
        skirt_chart,
    )


def _stretch(
    uv: Float[np.ndarray, "uvs 2"], uv_faces: Int[np.ndarray, "faces 3"]
) -> Float[np.ndarray, "uvs 2"]:
    """Crops the chart, then stretches each row so that the smoothed outline reaches the sides."""
    used = np.unique(uv_faces)
    low, high = uv[used].min(axis=0), uv[used].max(axis=0)
    out = (uv - low) / (high - low)
    levels = np.linspace(0.0, 1.0, 201)
    x, y = np.abs(out[used, 0] - 0.5), out[used, 1]
    reach = np.asarray([x[np.abs(y - v) <= _SMOOTH].max(initial=0.05) for v in levels])
    # The running maximum keeps everything inside; the mean keeps the map smooth.
    kernel = np.ones(2 * int(_SMOOTH * 200 / 2) + 1)
    kernel /= kernel.sum()
    half = len(kernel) // 2
    smooth = np.convolve(np.pad(reach, half, mode="edge"), kernel, mode="valid")
    wide = np.interp(out[:, 1], levels, smooth)
    margin = 0.998
    out[:, 0] = 0.5 + 0.5 * margin * (out[:, 0] - 0.5) / wide
    out[:, 1] = 0.5 + margin * (out[:, 1] - 0.5)
    return np.clip(out, 0.0, 1.0)
