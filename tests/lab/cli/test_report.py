"""The report's command line."""

from __future__ import annotations

from lab.report.fakes import write_run


def test_report_of_several_folders(tmp_path, run):
    curve = {1000: [1.0, 2.0], 2000: [3.0, 4.0]}
    write_run(tmp_path / "a" / "0", curve, choice="cql")
    write_run(tmp_path / "b" / "0", curve, overrides=["loss=osr"])
    write_run(tmp_path / "b" / "1", curve, overrides=["loss=osr"], status="running")
    options = ["a", "b", "--reference", "osr", "--output", "new/report"]
    output = run(tmp_path, "report", *options)
    assert "left out: b/1: not finished, its status is running\n" in output
    assert output.endswith("2 runs in new/report/report.html\n")
    page = (tmp_path / "new" / "report" / "report.html").read_text(encoding="utf-8")
    assert "cql is worse than" not in page
    assert "too few seeds (1 of 5)" in page
    assert "a b --reference osr --output new/report" in page
    assert run(tmp_path, "report", "nowhere", code=1) == "nowhere does not exist.\n"
