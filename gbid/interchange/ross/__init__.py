"""Exchange with ROSS, the finite-element rotor programme: rotors as structures, identified bearings as elements."""

from gbid.interchange.ross.bearing_elements import bearing_element
from gbid.interchange.ross.rotor_structure import from_ross

__all__ = ["bearing_element", "from_ross"]
