"""Logs of your own: files, columns by name, order by step."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pyarrow
import pytest
import torch
from pyarrow import parquet
from recorded_logs import make_columns, save

from torchrl_osr.lab.data import load_dataset, transitions_from_columns
from torchrl_osr.lab.data.table import find_columns

NAMED = {"observation": ["x", "theta", "v"], "action": ["u", "w"], "episode": "run"}
WANTED = NAMED | {"reward": "cost", "terminated": "fell"}


def robot(**changes):
    """Return a robot's log, whose columns are called as its driver calls them."""
    columns = make_columns(120)
    entries = [*columns["observation"].T, *columns["action"].T]
    frame = pd.DataFrame(dict(zip(["x", "theta", "v", "u", "w"], entries, strict=True)))
    frame["cost"] = columns["reward"]
    frame["fell"] = columns["terminated"].astype(int)
    frame["run"] = [f"monday {number}" for number in np.arange(120) // 40]
    frame["tick"] = np.arange(120) % 40
    return frame.assign(**changes)


def csv(folder, frame):
    frame.to_csv(folder / "plain.csv", index=False)
    return folder / "plain.csv"


@pytest.fixture(params=[".csv", ".parquet"])
def write(request, tmp_path):
    def write(frame):
        if request.param == ".csv":
            return csv(tmp_path, frame)
        frame.to_parquet(tmp_path / "log.parquet")
        return tmp_path / "log.parquet"

    return write


@pytest.mark.parametrize("ending", ["npz", "hdf5", "parquet"])
def test_all_kinds_of_files_hold_the_same(tmp_path, ending):
    expected, about = transitions_from_columns(make_columns())
    path = save(tmp_path / f"log.{ending}", make_columns())
    data, manifest = load_dataset(path=path)
    assert (data == expected).all()
    assert about.items() <= manifest.items()
    path.write_bytes(path.read_bytes()[:2000])
    with pytest.raises(ValueError, match=r"log\.\w+"):
        load_dataset(path=path)


@pytest.mark.parametrize(
    ("name", "options", "text"),
    [
        ("log.csv", {"sep": ";", "encoding": "utf-8-sig"}, "';', decimal '.', UTF-8"),
        ("log.csv.gz", {"sep": ";", "decimal": ","}, "';', decimal ',', UTF-8"),
        ("log.csv", {"sep": "\t", "encoding": "utf-16"}, "'\\t', decimal '.', UTF-16"),
        ("log.csv", {"decimal": ",", "sep": ";", "encoding": "cp1252"}, "',', cp1252"),
    ],
)
def test_separators_decimals_and_encodings_are_detected(tmp_path, name, options, text):
    robot(größe="weiß").to_csv(tmp_path / name, index=name == "log.csv.gz", **options)
    expected, _ = load_dataset(path=csv(tmp_path, robot()), columns=WANTED)
    data, manifest = load_dataset(path=tmp_path / name, columns=WANTED)
    assert (data == expected).all()
    assert text in manifest["text"]
    assert manifest["unused_columns"] == ["tick", "größe"]


def test_comments_blank_lines_and_spaces_are_skipped(tmp_path):
    expected, _ = load_dataset(path=csv(tmp_path, robot()), columns=WANTED)
    lines = robot(fell=robot()["fell"] == 1).to_csv(index=False).splitlines()
    lines = ["# robot 7", f"# {lines[0].replace(',', ', ')},", "", *lines[1:]]
    lines.append(9 * ",")  # as Excel writes them
    text = "\n".join(lines).replace("True", " true").replace("monday 2", " monday 2")
    (tmp_path / "log.csv").write_text(text.replace("\n\n", "\n"))
    data, _ = load_dataset(path=tmp_path / "log.csv", columns=WANTED)
    assert (data == expected).all()


def test_columns_are_taken_by_their_names(write):
    frame = robot()
    columns = {
        "observation": frame[["theta", "x", "v"]].to_numpy(),
        "action": frame[["u", "w"]].to_numpy(),
        "reward": frame["cost"].to_numpy(),
        "terminated": frame["fell"].to_numpy(),
        "episode": np.arange(120) // 40,
    }
    wanted = WANTED | {"observation": ["theta", "x", "v"]}
    data, manifest = load_dataset(path=write(frame), columns=wanted)
    assert (data == transitions_from_columns(columns)[0]).all()
    assert manifest["unused_columns"] == ["tick"]


def stamps(ticks):
    times = pd.Timestamp("2026-03-29T01:59:59+01:00") + pd.to_timedelta(ticks / 50, "s")
    return [time.isoformat() for time in times]


@pytest.mark.parametrize(
    "clock", [lambda ticks: ticks, lambda t: t / 50, lambda t: 20 * t + t % 2, stamps]
)
def test_steps_bring_the_rows_of_an_episode_into_order(write, clock):
    expected, _ = load_dataset(path=write(robot()), columns=WANTED)
    ordered = robot().assign(tick=clock(robot()["tick"]))
    shuffled = ordered.sample(frac=1, random_state=0)
    wanted = WANTED | {"step": "tick"}
    data, manifest = load_dataset(path=write(shuffled), columns=wanted)
    rate = "0.02 s apart (50 a second)" if clock is stamps else "apart"
    assert rate in manifest["steps"]
    # Episodes in the order in which they come up in the file.
    order = {name: i for i, name in enumerate(shuffled["run"].unique())}
    parts = np.argsort([order[f"monday {number}"] for number in range(3)])
    ends = expected["next", "done"][:, 0].nonzero()[:, 0] + 1
    episodes = expected.split(np.diff(ends.numpy(), prepend=0).tolist())
    assert (data == torch.cat([episodes[part] for part in parts])).all()
    with pytest.raises(ValueError, match="where steps are .* or the rate changes"):
        load_dataset(path=write(ordered.drop(index=17)), columns=wanted)
    holed = ordered.drop(index=17).assign(**{f"next_{n}": 0.5 for n in "xyz"})
    known = wanted | {"next_observation": "next_*"}
    _, manifest = load_dataset(path=write(holed), columns=known)
    assert "as in 1 places: rows are missing" in manifest["warnings"][0]
    with pytest.raises(ValueError, match="'tick' holds 10:00; expected numbers, or ti"):
        load_dataset(path=write(ordered.assign(tick="10:00")), columns=wanted)
    with pytest.raises(ValueError, match="the rows in another order"):
        load_dataset(path=write(shuffled), columns=WANTED)
    ordered.loc[17, "tick"] = ordered.loc[16, "tick"]
    with pytest.raises(ValueError, match="where steps are"):
        load_dataset(path=write(ordered), columns=wanted)


def test_several_files_are_one_log(tmp_path):
    columns = make_columns(120) | {"episode": np.arange(120) % 60 // 40}
    del columns["truncated"], columns["terminated"]
    halves = [{n: c[i : i + 60] for n, c in columns.items()} for i in (0, 60)]
    paths = [str(save(tmp_path / f"{i}.npz", half)) for i, half in enumerate(halves)]
    names = {"terminated": False}
    parts = [load_dataset(path=path, columns=names)[0] for path in paths]
    (tmp_path / "deeper" / "still").mkdir(parents=True)
    deep = str(save(tmp_path / "deeper" / "still" / "1.npz", halves[1]))
    _, manifest = load_dataset(path=str(tmp_path / "**" / "*.npz"), columns=names)
    assert manifest["path"] == [*paths, deep]
    for path in (paths, str(tmp_path / "*.npz"), [str(tmp_path / "*.npz"), paths[0]]):
        data, manifest = load_dataset(path=path, columns=names)
        assert (data == torch.cat(parts)).all()
        assert manifest["path"] == paths
    with pytest.raises(FileNotFoundError, match="no file .*2.npz"):
        load_dataset(path=[*paths, str(tmp_path / "2.npz")], columns=names)
    # Episodes are numbered anew in each file.
    assert manifest["incomplete_lengths"] == [40, 20, 40, 20]
    paths = [csv(tmp_path, robot()), tmp_path / "other.csv"]
    lacking, holed = robot().drop(columns="cost"), robot(theta=np.nan)
    for frame, flaw in (lacking, "it lacks .'cost'"), (holed, "'observation' has no"):
        frame.to_csv(paths[1], index=False)
        with pytest.raises(ValueError, match=f"other.csv: {flaw}"):
            load_dataset(path=[*map(str, paths)], columns=WANTED)
    options = {"columns": WANTED, "missing": "episode"}  # the second file has none
    assert len(load_dataset(path=[*map(str, paths)], **options)[0]) == 119


def test_row_names_of_pandas_are_columns_if_they_have_a_name(tmp_path):
    expected, _ = load_dataset(path=csv(tmp_path, robot()), columns=WANTED)
    for frame in (robot().set_index("run"), robot().set_index(2 * np.arange(120))):
        frame.to_parquet(tmp_path / "log.parquet")
        data, about = load_dataset(path=tmp_path / "log.parquet", columns=WANTED)
        assert (data == expected).all()
        assert about["unused_columns"] == ["tick"]


def test_rows_without_ends_and_values(write):
    frame = robot(theta=[np.nan, *robot()["theta"][1:]]).drop(columns="fell")
    wanted = WANTED | {"terminated": False}
    with pytest.raises(ValueError, match="'observation' has no value in row 0"):
        load_dataset(path=write(frame), columns=wanted)
    data, manifest = load_dataset(path=write(frame), columns=wanted, missing="row")
    assert not data["next", "terminated"].any()
    assert (len(data), manifest["missing_rows"]) == (120 - 3 - 1, 1)
    assert manifest["unmarked_ends"] == 3
    still = {"path": write(robot(w=0.5)), "action_bounds": "log"}
    (_, low), (_, high) = load_dataset(**still, columns=WANTED)[1]["action_bounds"]
    assert (low, high) == (-0.5, 1.5)


OBS = [f"obs_{number}" for number in range(10, -1, -1)]
USUAL = [*OBS, "action", "reward", "terminated", "episode"]


def test_names_are_found_in_the_order_of_their_numbers():
    columns = find_columns(USUAL, {})
    assert columns["observation"] == OBS[::-1]
    assert [*columns] == ["observation", "action", "reward", "terminated", "episode"]
    named = {"observation": "obs_*", "action": "action"}
    assert find_columns([*USUAL, "note"], named) == columns
    named["observation"] = ["obs_3", "obs_1"]
    assert find_columns(USUAL, named)["observation"] == ["obs_3", "obs_1"]
    named["observation"] = [7]
    assert find_columns(["7", *USUAL], named)["observation"] == ["7"]
    named["observation"], feet = "foot*", ["foot0x", "foot0y", "foot1x", "foot1y"]
    assert find_columns([*feet, *USUAL], named)["observation"] == feet
    named["observation"], after = ["obs_3", "obs_1"], ["next_obs_3", "next_obs_1"]
    assert find_columns([*after[::-1], *USUAL], named)["next_observation"] == after


@pytest.mark.parametrize(
    ("names", "wanted", "message"),
    [
        (USUAL, {"action": "force"}, r"action=force names 0 columns; there are obs_10"),
        (USUAL, {"action": "action", "reward": "action"}, "'action' is read twice"),
        (["obs_0", "obs_2", *USUAL[11:]], {}, "obs_0 to obs_2 lack number 1"),
        (USUAL[:-1], {}, "the data lack truncated or episode; there"),
        (USUAL[:-2], {}, "lack terminated.*terminated=false if noth"),
        ([*USUAL, "note"], {}, "unknown columns note"),
    ],
)
def test_wrong_columns_are_named(names, wanted, message):
    with pytest.raises(ValueError, match=message):
        find_columns(names, wanted)


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ("obs_0,action,reward,terminated,episode\n1,a,3,0,0\n", "'action' holds other"),
        ("obs_0,action,reward,terminated,episode\n1,.2,3,0,0,9\n", "more values than"),
        ("obs_0,action,reward,terminated,episode\n1,.2,3\n", "no value in row 0"),
        ("obs_0,action,reward,terminated,episode\n,,,,\n1,.2,3,0,0", "in row 0 of 2"),
        ("obs_0,action,reward,terminated,episode\n", "holds no rows"),
        ("0.5,.2,3,0,0\n1,.2,3,0,0\n", "the first line holds numbers; .* a header"),
        ("1,1,0\n1,.2,3\n", "the first line holds numbers"),
        ("obs,obs,action\n1,.2,3\n", "two columns are named 'obs'"),
        ("obs;action\n1,234;0.5\n", "in 0.5 and 1,234: write all numbers alike"),
    ],
)
def test_wrong_csv_files_are_refused(tmp_path, rows, message):
    (tmp_path / "log.csv").write_text(rows)
    with pytest.raises(ValueError, match=message):
        load_dataset(path=tmp_path / "log.csv")


def test_a_file_that_was_cut_off_is_named(tmp_path):
    robot().to_csv(path := tmp_path / "log.csv.gz", index=False)
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(ValueError, match=r"log.csv.gz: .*ended before"):
        load_dataset(path=path, columns=WANTED)


def test_names_of_columns_may_be_numbers(tmp_path):
    table = np.random.default_rng(0).random((60, 5))
    table[:, 4] = 20260329 + np.arange(60) // 20
    names = {"observation": [1, 2], "action": 3, "episode": 4, "terminated": False}
    pd.DataFrame(table).to_csv(tmp_path / "log.csv", index=False)
    data, _ = load_dataset(path=tmp_path / "log.csv", columns={"reward": 0, **names})
    assert data["next", "reward"][0, 0] == np.float32(table[0, 0])
    pd.DataFrame(np.tile(table, (2, 1))).to_csv(tmp_path / "log.csv", index=False)
    with pytest.raises(ValueError, match="'episode' 20260329 comes back"):
        load_dataset(path=tmp_path / "log.csv", columns=names)


def test_rows_of_other_shapes_are_refused(tmp_path):
    columns = {k: list(v) if v.ndim > 1 else v for k, v in make_columns(60).items()}
    columns["observation"][3] = None
    parquet.write_table(pyarrow.table(columns), tmp_path / "log.parquet")
    _, manifest = load_dataset(path=tmp_path / "log.parquet", missing="row")
    assert manifest["missing_rows"] == 1
    columns["action"] = [[0.1], [0.2, 0.3, 0.1]] * 30
    parquet.write_table(pyarrow.table(columns), tmp_path / "log.parquet")
    with pytest.raises(ValueError, match="must have the same shape"):
        load_dataset(path=tmp_path / "log.parquet")
    columns = {name: np.stack([c] * 2) for name, c in make_columns(60).items()}
    with pytest.raises(ValueError, match=r"'observation' has shape \[2, 60, 3\]"):
        load_dataset(path=save(tmp_path / "log.npz", columns))
    columns = make_columns(60) | {"action": make_columns(50)["action"]}
    columns |= {"time": np.arange(60), "episode": np.arange(60) // 20}
    with pytest.raises(ValueError, match=r"'action' has shape \[50, 2\]"):
        load_dataset(path=save(tmp_path / "x.npz", columns), columns={"step": "time"})
