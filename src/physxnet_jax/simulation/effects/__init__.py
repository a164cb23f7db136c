"""The effects that a scene can list, one module each."""

from ._air import TURBULENCE_PERIOD as TURBULENCE_PERIOD, Air as Air
from ._bend import Bend as Bend
from ._contact import BodyContact as BodyContact
from ._damping import Damping as Damping
from ._dihedral import Dihedral as Dihedral
from ._elastic import Elastic as Elastic
from ._floor import Floor as Floor
from ._gravity import Gravity as Gravity
from ._guide import Guide as Guide, PreparedGuide as PreparedGuide
from ._layers import LayerContact as LayerContact
from ._membrane import Membrane as Membrane
from ._pin import Pin as Pin
from ._seam import Seam as Seam
from ._self_contact import SelfContact as SelfContact
from ._strain_limit import StrainLimit as StrainLimit
from ._stretch import Stretch as Stretch
from ._tether import Tether as Tether
