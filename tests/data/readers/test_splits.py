"""Which recordings of a copy make a split, in every dataset: one table. Nothing is read."""

import json
import warnings
from pathlib import Path

import pytest

from gnio_jax import data
from gnio_jax.data.readers import euroc, kitti, oxiod, ronin
from gnio_jax.data.splits import hold_out
from gnio_jax.errors import InputError

PEOPLE = [{"subjectID": who, "calibration": "start"} for who in (*range(5), 14)]
"""Of IDOL."""
TRAINING = {str(n): PEOPLE[n // 2] for n in range(10)}
COPIES = {
    "tlio": r"""
        files {}/imu0_resampled.npy a b c
        text train_list.txt a|not_here|b|nor_this
        text test_list.txt c||
        split train a b
        split test c
        warns train train_list.txt: 2 of 4 listed sequences are absent: not_here, nor_this""",
    "blackbird": r"""
        files clover/yawForward/maxSpeed5p0/{}/data.hdf5 train test
        text train.txt # clover|clover/yawForward/maxSpeed5p0/train|star/train
        text test.txt |clover/yawForward/maxSpeed5p0/test|
        split train clover_yawForward_maxSpeed5p0_train
        split test clover_yawForward_maxSpeed5p0_test
        warns train train.txt: 1 of 2 listed sequences are absent: star/train""",
    "ronin": r"""
        files {}/data.hdf5 train_dataset_1/a001_1 train_dataset_2/a009_2
        files seen_subjects_test_set/{}/data.hdf5 a000_1 a011_2
        files unseen_subjects_test_set/{}/data.hdf5 deeper/a006_2
        text ronin/lists/list_train.txt a001_1|a007_3|a000_1
        text ronin/lists/list_val.txt a009_2
        text ronin/lists/list_test_seen.txt a011_2|
        text ronin/lists/list_test_unseen.txt a006_2
        split train a001_1 a000_1
        split val a009_2
        split test,seen a011_2
        split unseen a006_2
        warns train list_train.txt: 1 of 3 listed sequences are absent: a007_3""",
    "ridi": r"""
        files deep/{}/processed/data.csv dan_bag1 dan_bag9 dan_leg2 hang_bag1 hao_bag1 hao_body1
        files deep/{}/processed/data.csv ma_bag1 yajie_leg1 hang_leg7 shali_bag1
        text deep/list_train_publish_v2.txt dan_bag1,bag|dan_leg2,leg|hang_bag1,bag|hao_bag1,bag\
|hao_body1,body|ma_bag1,bag|yajie_leg1,leg|zhicheng_bag1,bag
        text deep/list_test_publish_v2.txt hang_leg7,leg|hang_leg_new3,leg
        text deep/list_crosssubject.txt # others|shali_bag1|ruixuan_bag1
        split train dan_bag1 dan_leg2 hang_bag1 hao_bag1 hao_body1 yajie_leg1
        split val ma_bag1
        split test,seen hang_leg7
        split unseen shali_bag1
        split all dan_bag1 dan_bag9 dan_leg2 hang_bag1 hang_leg7 hao_bag1 hao_body1 ma_bag1 \
shali_bag1 yajie_leg1
        warns train 1 of 8 listed sequences are absent: zhicheng_bag1,bag
        warns val absent: zhicheng_bag1
        warns test,seen absent: hang_leg_new3
        warns unseen absent: ruixuan_bag1""",
    "idol": rf"""
        files deep/building1/train/{{}}.feather 0 1 2 3 4 5 6 7 8 9
        files deep/{{}}.feather building1/known/0 building2/known/10 building2/known/9
        files deep/{{}}.feather building3/unknown/0
        text deep/building1/train/metadata.json {json.dumps(TRAINING)}
        text deep/building1/known/metadata.json {{"0": {{"subjectID": 1}}}}
        text deep/building2/known/metadata.json {{"9": {{"subjectID": 2}},"10": {{"subjectID": 2}}}}
        text deep/building3/unknown/metadata.json {{"0": {json.dumps(PEOPLE[-1])}}}
        split train building1_train_0 building1_train_1 building1_train_2 building1_train_3 \
building1_train_6 building1_train_7 building1_train_8 building1_train_9
        split val building1_train_4 building1_train_5
        split known,seen,test building1_known_0 building2_known_9 building2_known_10
        split unknown,unseen building3_unknown_0""",
    "euroc": r"""
        files {}/mav0/imu0/data.csv machine_hall/MH_01_easy machine_hall/MH_05_difficult
        files {}/mav0/imu0/data.csv V1_02_medium V2_03_difficult my_flight
        split train MH_01_easy
        split val V1_02_medium
        split test,seen MH_05_difficult my_flight
        split unseen V2_03_difficult""",
    "tumvi": r"""
        files dataset-{}_16/mav0/imu0/data.csv room1_512 room1_1024 room2_1024 room3_512
        files dataset-{}_16/mav0/imu0/data.csv calib-imu1_512
        split train room1 room2
        split val room3""",
    "kitti": r"""
        files train__2011_09_26_drive_{}.npz 0014_extract0 0014_extract1 0009_extract0 0018_extract3
        split train 2011_09_26_drive_0014_extract0 2011_09_26_drive_0014_extract1
        split val 2011_09_26_drive_0009_extract0
        split test 2011_09_26_drive_0018_extract3""",
    "tyrex": r"""
        files android/Thibaud_{}/ Nexus5_Dist_AR iPhone5_NoDist_AR
        files android/Guillaume_{}/ iPhone5_Dist_AR Nexus5_NoDist_RunningHand
        files android/{}/ notes
        split train Thibaud_Nexus5_Dist_AR Thibaud_iPhone5_NoDist_AR
        split val Guillaume_iPhone5_Dist_AR
        split test Guillaume_Nexus5_NoDist_RunningHand
        split all Guillaume_Nexus5_NoDist_RunningHand Guillaume_iPhone5_Dist_AR \
Thibaud_Nexus5_Dist_AR Thibaud_iPhone5_NoDist_AR""",
    "indoor_location": r"""
        files site1/{}/path_data_files/x.txt B1 F1 F2 F3 F4 F9
        split train site1_B1_x site1_F1_x site1_F2_x
        split val site1_F3_x
        split test site1_F4_x
        split all site1_B1_x site1_F1_x site1_F2_x site1_F3_x site1_F4_x site1_F9_x""",
    "csv": r"""
        files {} a.csv b.csv c.csv d.h5 notes.md
        text train.txt # mine|a|b.csv|gone.csv
        text test.txt d|
        text winter.txt c
        text readme.txt walk through the park, phone in the hand
        split train a b
        split test d
        split winter c
        warns train train.txt: 1 of 3 listed sequences are absent: gone.csv""",
    "oxiod": r"""
        files deep/deeper/handheld/{}.csv data1/syn/imu2 data1/syn/vi2 data5/syn/imu1 data5/syn/vi1
        files deep/deeper/running/data1/syn/{}.csv imu7 vi7
        text deep/deeper/handheld/Train.txt data1|data2
        text deep/deeper/handheld/Test.txt data5
        text deep/deeper/running/Train.txt data1/imu1.csv
        text deep/deeper/running/Test.txt data1/imu7.csv
        split train handheld_data1_2
        split test,seen handheld_data5_1 running_data1_7
        warns train 2 entries of the lists Train.txt are not in this copy""",
}
"""What lies below a root: files by a path and what stands in it for `{}` (folders, where it ends
with /), and texts, with | for the end of a line, which the last one may lack, as published. Then
the names of each split, and what is said of entries of its list that the copy lacks."""


def entries(name, kind):
    """(name, content) of the lines of this kind."""
    lines = COPIES[name].replace("\\\n", "").strip().splitlines()
    words = (line.split(maxsplit=2) for line in lines)
    return [
        (item, content)
        for keyword, names, content in words
        if keyword == kind
        for item in names.split(",")
    ]


@pytest.fixture
def copied(tmp_path):
    """Lays a copy of a dataset below the root, and gives the root."""

    def lay(name: str) -> Path:
        for template, places in entries(name, "files"):
            for part in places.split():
                path = tmp_path / template.format(part)
                path.parent.mkdir(parents=True, exist_ok=True)
                path.mkdir() if template.endswith("/") else path.touch()
        for file, text in entries(name, "text"):
            (tmp_path / file).parent.mkdir(parents=True, exist_ok=True)
            (tmp_path / file).write_text(text.replace("|", "\n"))
        return tmp_path

    return lay


def names(name, root, split):
    return " ".join(recording.name for recording in data.get(name).recordings(root, split))


@pytest.mark.parametrize("name", COPIES)
def test_splits(copied, name):
    root, absent = copied(name), dict(entries(name, "warns"))
    for split, expected in entries(name, "split"):
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            assert names(name, root, split) == expected, split
        lines = [str(warning.message) for warning in caught]
        assert len(lines) == (split in absent) and all(absent[split] in line for line in lines)


HANDHELD, RUNNING = "deep/deeper/handheld", "deep/deeper/running"
WRONG = [
    # dataset, what becomes of files (None: gone), split, problem
    ("ridi", {"deep/list_train_publish_v2.txt": "dan_bag1"}, "val", "would be empty"),
    ("idol", {f"deep/building1/train/{n}.feather": None for n in range(2, 10)}, "val", "0 of 1"),
    ("euroc", {"V1_02_medium/mav0/imu0/data.csv": None}, "val", "sequences are V1_02_medium"),
    ("tumvi", {}, "test", "holds no sequence of split 'test'"),
    ("kitti", {"train__2011_09_26_drive_0009_extract0.npz": None}, "val", "none of its drives"),
    ("indoor_location", {"site1/F3/path_data_files/x.txt": None}, "val", "the floors F3"),
    ("csv", {"train.txt": None, "test.txt": None}, "train", "has no list train.txt; "),
    ("csv", {}, "readme", "unknown split 'readme'"),
    ("oxiod", {}, "unseen", "no recording of split 'unseen'"),
    ("oxiod", {f"{HANDHELD}/Train.txt": "data1/vi3.csv"}, "train", "'data1/vi3.csv'"),
    ("oxiod", {f"{HANDHELD}/Train.txt": "\n"}, "train", "Train.txt: the list is empty"),
    ("oxiod", {f"{HANDHELD}/Test.txt": None, f"{RUNNING}/Test.txt": None}, "test", "no scene has"),
    *((name, None, data.get(name).splits[-1], "expected layout: ") for name in COPIES),
]


@pytest.mark.parametrize(("name", "changes", "split", "problem"), WRONG)
def test_a_split_that_is_not_there_is_refused(copied, tmp_path, name, changes, split, problem):
    root = tmp_path if changes is None else copied(name)
    for file, text in (changes or {}).items():
        if text is not None:
            (root / file).write_text(text)
        else:
            (root / file).unlink()
    with pytest.raises(InputError) as caught:
        next(data.load_each(name, root, split))
    assert str(caught.value).startswith(str(root)) and problem in str(caught.value)


@pytest.mark.filterwarnings("ignore:.*absent")
def test_who_is_held_out_is_written_in_every_sequence(copied):
    for name, who in (("ridi", "ma"), ("idol", "subject2")):
        root = copied(name)
        for split in ("train", "val"):
            for recording in data.get(name).recordings(root, split):
                assert recording.attributes["held_out"] == who
                assert recording.slow and recording.files  # what is aligned is kept in the cache
    (labels,) = (recording.attributes for recording in data.get("idol").recordings(root, "unseen"))
    assert labels["subject"] == labels["group"] == "subject14" and labels["calibration"] == "start"
    (root / "deep/building1/train/metadata.json").unlink()
    nameless = r"metadata\.json does not name the subject of 10 recordings, e\.g\. .*0\.feather"
    with pytest.warns(UserWarning, match=nameless):
        train = data.get("idol").recordings(root, "train")
    assert all(recording.attributes["subject"] == recording.name for recording in train)


def test_who_validates_does_not_depend_on_what_a_copy_holds(tmp_path):
    folder, split_of = tmp_path / "building1" / "train", {}
    folder.mkdir(parents=True)
    entries = {str(n): {"subjectID": n % 20} for n in range(60)}
    (folder / "metadata.json").write_text(json.dumps(entries))
    for people in (range(20), range(0, 20, 2), range(11, 17)):
        for n in range(60):
            (folder / f"{n}.feather").unlink(missing_ok=True)
            if n % 20 in people:
                (folder / f"{n}.feather").touch()
        for split in ("train", "val"):
            for recording in data.get("idol").recordings(tmp_path, split):
                assert split_of.setdefault(recording.name, split) == split
    held = [entries[name.rpartition("_")[2]] for name, split in split_of.items() if split == "val"]
    assert {entry["subjectID"] for entry in held} == {2, 13} and len(held) == 6


def test_of_copies_the_first_is_taken_and_links_are_followed(copied, tmp_path, monkeypatch):
    root = copied("ronin") / "unseen_subjects_test_set"
    (root / "later" / "a006_2").mkdir(parents=True)
    (root / "later" / "a006_2" / "data.hdf5").touch()
    twice = r"1 recordings are there twice, e\.g\. .*later/a006_2; .*deeper/a006_2 is used"
    with pytest.warns(UserWarning, match=twice):
        assert names("ronin", tmp_path, "unseen") == "a006_2"
    (root / "later" / "a006_2" / "data.hdf5").unlink()
    # The truth chooses an orientation where one trains, and nowhere else.
    monkeypatch.setattr(ronin, "read", lambda _, choose: choose)
    for split, choose in (("val", True), ("seen", False), ("unseen", False), ("test", False)):
        assert [recording.read() for recording in ronin.recordings(tmp_path, split)] == [choose]
    linked = tmp_path / "linked"
    linked.mkdir()
    (linked / "unseen").symlink_to(root)
    (root / "round").symlink_to(linked)  # a circle must not hang it
    (linked / "list_test_unseen.txt").write_text("a006_2")
    assert names("ronin", linked, "unseen") == "a006_2"


def test_splits_by_names_are_disjoint_and_what_is_unseen_is_of_another_room():
    for splits in (euroc.EUROC_SPLITS, euroc.TUMVI_SPLITS):
        every = [name for chosen in splits.values() for name in chosen]
        assert len(every) == len(set(every)) == {"V2_01_easy": 11}.get(splits["unseen"][0], 28)
    rooms = {split: {name[:2] for name in names} for split, names in euroc.EUROC_SPLITS.items()}
    assert not rooms.pop("unseen") & set.union(*rooms.values())
    drives = [f"2011_{month:02d}_26_drive_{n:04d}" for month in (9, 10) for n in range(500)]
    shares = [kitti.split_of(drive) for drive in drives]
    for split, share in (("train", 0.7), ("val", 0.1), ("test", 0.2)):
        assert shares.count(split) / len(drives) == pytest.approx(share, abs=0.04)


# --- the sessions of OxIOD


def walks(*names):
    """Walks without files, by their "scene/session/number"."""
    parts = [name.split("/") for name in names]
    return [oxiod.WalkFiles(scene, folder, int(number), {}, "") for scene, folder, number in parts]


ROOM = walks(
    *(f"handheld/data{n}/{k}" for n in range(1, 6) for k in (1, 2)),
    *("pocket/data1/1", "handbag/data2/4", "trolley/data1/7", "trolley/data2/3", "running/data1/6"),
    *(f"multi users/user{n}/4" for n in range(2, 6)),
    *(f"multi devices/{device}/1" for device in ("iPhone 5", "iPhone 6", "nexus 5")),
)


def test_sessions_are_shared_out_whole_whatever_a_copy_holds(tmp_path):
    for scene, entries in (("handheld", "data1\ndata4"), ("trolley", "data1/imu7.csv\ndata2")):
        (tmp_path / scene).mkdir()
        (tmp_path / scene / "Train.txt").write_text(entries)
    sessions = {}
    for split in ("sessions_train", "sessions_val", "sessions_test", "train", "val"):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            whole = oxiod.select(ROOM, split, tmp_path)
            for part in (ROOM[::2], ROOM[1::2], ROOM[:7], ROOM[7:]):
                selection = oxiod.select(part, split, tmp_path)
                assert selection == [walk for walk in whole if walk in part], split
        sessions[split] = {walk.session for walk in whole}
    train, val, test = (sessions[f"sessions_{split}"] for split in ("train", "val", "test"))
    assert train | val | test == {walk.session for walk in ROOM}
    assert len(train) + len(val) + len(test) == len(train | val | test)
    scenes = {session.partition("/")[0] for session in train}
    assert {"handheld", "trolley", "multi users", "multi devices"} <= scenes
    assert val == {"multi users/user4", "handheld/data4"}
    assert {"multi users/user2", "multi devices/nexus 5", "trolley/data1"} < test
    assert sessions["val"] == {"handheld/data4", "trolley/data1"}
    assert sessions["train"] == {"handheld/data1", "trolley/data2"}


def test_who_is_held_out_depends_on_the_names_alone():
    """Whole people; of one person whole recordings; of three recordings none."""
    pairs = {f"p{n // 2}_{n}": f"p{n // 2}" for n in range(20)}
    held = hold_out(pairs)
    assert held == hold_out(dict(reversed(pairs.items())))
    assert len(held) == 2 and len({pairs[name] for name in held}) == 1
    assert len(hold_out({f"dan_{n}": "dan" for n in range(20)})) == 2
    assert hold_out({"dan_1": "dan", "dan_2": "dan", "hang_1": "hang"}) == set()
