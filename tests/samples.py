"""Small files that are right, and a measure of clips, for tests of several rooms."""

import numpy as np

from physxnet_jax.motion import LIMBS, clip_transforms

BVH = """HIERARCHY
ROOT Hips
{
  OFFSET 0 0 0
  CHANNELS 6 Xposition Yposition Zposition Zrotation Yrotation Xrotation
  JOINT Knee
  {
    OFFSET 0 -1 0
    CHANNELS 3 Zrotation Yrotation Xrotation
    End Site
    {
      OFFSET 0 -1 0
    }
  }
}
MOTION
Frames: 2
Frame Time: 0.0083333
0 1 0 0 0 0 0 0 0
0 1 0 0 0 90 10 0 0
"""
ASF = """:version 1.10
:units
  mass 1.0
  length 0.45
  angle deg
:root
  order TX TY TZ RX RY RZ
  axis XYZ
  position 0 0 0
  orientation 0 0 0
:bonedata
  begin
    id 1
    name lfemur
    direction 0 -1 0
    length 2
    axis 0 0 20 XYZ
    dof rx
  end
:hierarchy
  begin
    root lfemur
  end
"""
AMC = ":FULLY-SPECIFIED\n:DEGREES\n1\nroot 0 1 0 0 0 0\nlfemur 10\n2\nroot 0 1 0 0 0 0\nlfemur 20\n"


def limbs_apart(body, rest, a, b):
    """Largest angle between limbs of two clips [degrees]."""
    at = []
    for motion in (a, b):
        world, shift = (np.asarray(x) for x in clip_transforms(body, rest, motion))
        heads = np.asarray(body.joint_positions(rest)[0])
        at.append(np.einsum("fjab,jb->fja", world, heads) + shift)
    worst = 0.0
    for p, q in LIMBS.items():
        d, e = (x[:, body.joint(q)] - x[:, body.joint(p)] for x in at)
        cosine = (d * e).sum(1) / np.linalg.norm(d, axis=1) / np.linalg.norm(e, axis=1)
        worst = max(worst, float(np.degrees(np.arccos(np.clip(cosine, -1, 1))).max()))
    return worst
