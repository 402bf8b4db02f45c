"""Cross-validation as tasks: pairs that cannot be validated are remembered, the others are in the table."""

from experiment_files import gbid, json_of, write_spring, write_spring_data


def outcomes_of(path, capsys, *options):
    document = json_of(capsys, "crossval", path, *options, code=3)
    return document, {o["item"]: o for o in document["outcomes"] if o["stage"] == "crossval"}


def spring_of_two_clocks(folder, on):
    """Models of recordings with different sample times, which cannot be put to one another."""
    path = write_spring(folder, ("on: cyclic, minimum_percent: 90", f"on: {on}"))
    write_spring_data(folder / "data/run2.csv", 2, dt=4e-4)
    assert gbid("import", path) == gbid("fit", path) == 0
    return path


def test_a_pair_that_cannot_be_validated_is_told_again(tmp_path, capsys):
    path = spring_of_two_clocks(tmp_path, '"run*"')
    for state in ("made", "kept"):
        document, outcomes = outcomes_of(path, capsys)
        assert {item: o["state"] for item, o in outcomes.items()} == {
            "spring": state,
            "spring/run1 on run2": "failed",
            "spring/run2 on run1": "failed",
            "spring_summary.h5": state,
            "spring_summary.csv": state,
        }
        assert "sample time" in outcomes["spring/run1 on run2"]["text"]
        assert [(row["model"], row["recording"]) for row in document["crossval"]] == [
            ("run1", "run1"),
            ("run2", "run2"),
        ]
        assert [text.split(":")[0] for text in document["crossval_summary"][0]["failed"]] == [
            "run1 on run2",
            "run2 on run1",
        ]


def test_a_table_without_any_row_has_failed_and_is_not_tried_again(tmp_path, capsys):
    path = spring_of_two_clocks(tmp_path, "cyclic")
    for before in (False, True):
        document, outcomes = outcomes_of(path, capsys)
        assert list(outcomes) == ["spring"]
        assert (outcomes["spring"]["state"], outcomes["spring"]["failed_before"]) == ("failed", before)
        assert "sample time" in outcomes["spring"]["text"]
        assert document["crossval"] == []
    _, outcomes = outcomes_of(path, capsys, "--retry")
    assert not outcomes["spring"]["failed_before"]
