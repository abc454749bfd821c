"""Records of sensors: files with their units and clocks, flights, and noise.

What is recognised, converted or repaired is said in the notes of a `Reading`.
"""

from jrigid._public import list_public_names as _list_public_names
from jrigid.records._clock import Clock as Clock
from jrigid.records._clock import repair as repair
from jrigid.records._flights import flights as flights
from jrigid.records._found_in_records import Allan as Allan
from jrigid.records._found_in_records import Noise as Noise
from jrigid.records._found_in_records import Reading as Reading
from jrigid.records._found_in_records import allan as allan
from jrigid.records._found_in_records import noise as noise
from jrigid.records._found_in_records import rests as rests
from jrigid.records._read import read as read

_list_public_names(__name__)
