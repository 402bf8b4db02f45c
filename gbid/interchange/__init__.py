"""Export of models, fits and LPV models to other programs: MATLAB, spreadsheets, plain YAML."""

from gbid.interchange.csv_file import save_csv
from gbid.interchange.mat_file import Exportable, save_mat
from gbid.interchange.plain_yaml import save_yaml

__all__ = ["Exportable", "save_csv", "save_mat", "save_yaml"]
