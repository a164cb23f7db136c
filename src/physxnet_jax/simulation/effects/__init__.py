"""Effects, one file each. A scene holds the ones it calls for and nothing else."""

from ._bend import Bend as Bend
from ._contact import BodyContact as BodyContact
from ._damping import Damping as Damping
from ._gravity import Gravity as Gravity
from ._pin import Pin as Pin
from ._stretch import Stretch as Stretch
