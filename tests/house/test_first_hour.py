"""The table of the 25 features of a first hour: each names a finding of new users and a test that shows it."""

import ast
import csv

from places import ROOT

TABLE = ROOT / "tests" / "house" / "first_hour.csv"


def test_each_feature_of_the_first_hour_names_a_test_that_is_there():
    with TABLE.open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert len({row["feature"] for row in rows}) == len({row["test"] for row in rows}) == 25
    assert {row["finding"] for row in rows} == set("ABCDEFGHIJ")
    for row in rows:
        path, _, name = row["test"].partition("::")
        tree = ast.parse((ROOT / path).read_text(encoding="utf-8"))
        assert name in {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}, row
