"""Tables: what is missing, no number or incomplete is named by file, column and row."""

import time

import h5py
import numpy as np
import pytest

from gnio_jax.data.parsing.tables import parsing_as, read_hdf5_fields, read_npz, read_text
from gnio_jax.data.parsing.text import layout_of
from gnio_jax.errors import InputError


def test_a_header_is_the_first_line_or_the_last_comment_above_numbers(tmp_path):
    path = tmp_path / "table.csv"
    for text in ("a, b\n1, 2\n", "# by hand\na,b\n1,2\n", "# by hand\n\n#a [ns],b\n1,2\n#3,4\n"):
        path.write_text(text)
        table = read_text(path)
        assert [str(name).partition(" ")[0] for name in table.columns] == ["a", "b"]
        np.testing.assert_array_equal(table.take(*table.columns), [[1.0, 2.0]])
    path.write_text("time,x\n1403636580838555648,1\n1403636580843555648,2\n")
    stamps = [1403636580838555648, 1403636580843555648]  # to their last digit
    np.testing.assert_array_equal(read_text(path).stamps("time"), stamps)
    path.write_text(",a,b\n0,1,2\n")  # pandas' index has no name
    np.testing.assert_array_equal(read_text(path).take("a", "b"), [[1.0, 2.0]])
    path.write_text("# one, two\n1,5;2\n3,5;4\n")
    np.testing.assert_array_equal(
        read_text(path, ";", header=False).take(0, 1), [[1.5, 2.0], [3.5, 4.0]]
    )


def test_rows_with_another_number_of_cells_than_the_header_are_told(tmp_path):
    path = tmp_path / "walk.csv"
    path.write_text("time,gyro_x,gyro_y\n" + "0.1\t1\t2\n" * 5)
    with pytest.raises(InputError, match=r"walk\.csv: row 2 has 1 cells, expected 3; correct"):
        read_text(path)


@pytest.mark.parametrize("separator", [",", ";", " "])
@pytest.mark.parametrize("header", [True, False])
def test_a_table_of_a_million_columns_is_refused_by_its_beginning(tmp_path, separator, header):
    path = tmp_path / "walk.csv"
    row = separator.join(["1.5"] * 200_000) + "\n"
    path.write_text(("time,gyro_x\n" if header else "") + 3 * row)
    for read in (read_text, layout_of):
        start = time.process_time()
        with pytest.raises(InputError, match="has more than 2000 columns; give the sensors' alone"):
            read(path)
        assert time.process_time() - start < 2.0
    path.write_text(separator.join(["1.5"] * 2000) + "\n")
    assert layout_of(path).width == 2000


def test_fields_of_binary_files_have_one_length_and_hold_numbers(tmp_path):
    fields = {"time": np.arange(5.0), "imu": np.ones((5, 6)), "short": np.ones((4, 3))}
    fields |= {"words": np.array([b"one"] * 5), "single": np.arange(5, dtype=np.float32)}
    fields["imu"][3, 2] = np.nan
    np.savez(tmp_path / "a.npz", **fields)
    with h5py.File(tmp_path / "a.h5", "w") as file:
        for name, values in fields.items():
            file[f"group/{name}"] = values
    names = [f"group/{name}" for name in fields]
    for table, prefix in (
        (read_npz(tmp_path / "a.npz"), ""),
        (read_hdf5_fields(tmp_path / "a.h5", names), "group/"),
    ):
        assert table.take(f"{prefix}single").dtype == np.float64
        assert np.isnan(table.take(f"{prefix}imu", width=6, gaps=True)).sum() == 1
        for name, width, words in (
            ("imu", 6, "is NaN or Inf in 1 rows, first in row 4"),
            ("imu", 3, r"has shape \(5, 6\), expected \(5, 3\)"),
            ("short", 3, r"has shape \(4, 3\), expected \(5, 3\)"),
            ("words", None, "holds .*expected numbers"),
            ("gone", None, "is missing; found: "),
        ):
            with pytest.raises(InputError, match=f"field '{prefix}{name}' {words}"):
                table.take(f"{prefix}{name}", width=width)


def test_hdf5_holds_what_it_gives(tmp_path):
    """A link may lead to any file, and a few bytes unpack to gigabytes: neither is followed."""
    path = tmp_path / "a.h5"
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["group/time"] = np.arange(5.0)
    with h5py.File(path, "w") as file:
        file["in/group/time"] = np.arange(5.0)
        file["group"] = h5py.ExternalLink("other.h5", "group")
        file["soft"] = h5py.SoftLink("/in/group")
        file.create_dataset("bomb", (10**10,), "f8", chunks=(10**6,), compression="gzip")
        layout = h5py.VirtualLayout((5,), "f8")
        layout[:] = h5py.VirtualSource(tmp_path / "other.h5", "group/time", (5,))
        file.create_virtual_dataset("virtual", layout)
        for name, kind in (("chunk", {"compression": "gzip"}), ("scaled", {"scaleoffset": 2})):
            options = {"chunks": (10**8,), "maxshape": (None,), **kind}
            file.create_dataset(name, (5,), "f8", **options)
    assert list(read_hdf5_fields(path, ["in/group/time", "in/gone", "gone/time"]).columns) == [
        "in/group/time"
    ]
    for name in ("group/time", "soft/time"):
        with pytest.raises(InputError, match=rf"a\.h5: field '{name}' is a link"):
            read_hdf5_fields(path, [name])
    sizes = {"bomb": 80_000_000_000, "virtual": 40, "chunk": 800_000_000, "scaled": 800_000_000}
    for name, size in sizes.items():
        problem = f"field '{name}' would take {size} bytes, which the file does not hold"
        with pytest.raises(InputError, match=problem):
            read_hdf5_fields(path, [name])


@pytest.mark.parametrize("share, words", [(90, None), (130, "would take .* bytes, which the fil")])
def test_a_compressed_field_is_read_up_to_a_ratio(tmp_path, share, words):
    """Zeros are compressed to a thousandth; a hundredth is what a recording may need."""
    random = np.random.default_rng(0).bytes(40_000)
    values = np.zeros(40_000 * share // 8 + 125_000, "f8")  # 1 MB is free
    values[: len(random) // 8] = np.frombuffer(random, "i8")
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.create_dataset("a", data=values, chunks=(len(values),), compression="gzip")
        stored = file["a"].id.get_storage_size()
    assert abs(stored - 40_000) < 8_000
    assert (values.nbytes < 100 * stored + 1_000_000) == (words is None)
    if words is None:
        assert read_hdf5_fields(tmp_path / "a.h5", ["a"]).columns["a"].nbytes == values.nbytes
    else:
        with pytest.raises(InputError, match=words):
            read_hdf5_fields(tmp_path / "a.h5", ["a"])


@pytest.mark.parametrize("cell", ["1_0", "\uff11\uff12", "\u0663", "0x10", "1e5x"])
def test_what_no_logger_writes_is_no_number(tmp_path, cell):
    """Python reads an underscore and digits of any script."""
    path = tmp_path / "walk.csv"
    path.write_text(f"time,a\n0,1\n1,{cell}\n2,3\n", encoding="utf-8")
    with pytest.raises(InputError, match=f"column 'a' holds '{cell}' in its row 3, no number"):
        read_text(path).take("a")


def test_a_mistake_of_ours_and_a_lack_of_memory_are_no_damage(tmp_path):
    path = tmp_path / "a.npz"
    for error, expected, words in (
        (AssertionError, AssertionError, "ours"),
        (NameError, NameError, "ours"),
        (ImportError, ImportError, "ours"),
        (MemoryError, InputError, "does not fit into memory as npz"),
        (EOFError, InputError, "may be cut short"),
    ):
        with pytest.raises(expected, match=words), parsing_as(path, "npz"):
            raise error("ours")
