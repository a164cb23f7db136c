"""The skin of a scene's person in chosen frames."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from ..body import NUM_BODY_VERTICES
from ..motion import Motion, animate
from ..simulation import Assembly


def animated_skin(
    assembly: Assembly, motion: Motion, frames: Int[np.ndarray, " looked"]
) -> Float[np.ndarray, "looked skin 3"]:
    """Skin vertices in these frames of a motion [m]."""
    body, rest = assembly.body, jnp.asarray(assembly.rest_body, jnp.float32)
    part = Motion(
        jax.device_put(motion.rotations)[frames], jax.device_put(motion.root)[frames], motion.fps
    )
    weights = jax.device_put(body.weights[:NUM_BODY_VERTICES])
    return np.asarray(animate(body, rest, rest[:NUM_BODY_VERTICES], weights, part))
