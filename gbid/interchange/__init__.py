"""Exchange with other programs: MATLAB, spreadsheets, plain YAML, ROSS."""

from gbid.interchange.csv_file import save_csv
from gbid.interchange.mat_file import Exportable, save_mat
from gbid.interchange.plain_yaml import save_yaml
from gbid.interchange.ross.bearing_elements import bearing_element
from gbid.interchange.ross.rotor_structure import from_ross

__all__ = ["Exportable", "bearing_element", "from_ross", "save_csv", "save_mat", "save_yaml"]
