"""Recordings that other people's libraries write: bags of ROS 2, datasets of LeRobot, tables."""

import json
import os
import sys
import tempfile
import unittest
from unittest import mock

import caudata
import numpy as np

try:
    import pyarrow
    import pyarrow.parquet as parquet
    from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore
except ImportError as error:
    raise unittest.SkipTest("%s: rosbags and pyarrow write the recordings" % error) from error

STORE = get_typestore(Stores.ROS2_HUMBLE)
JOINTS = "sensor_msgs/msg/JointState"
TIME_S = np.arange(0, 3, 0.02)
ASKED = 0.5 * np.sin(3 * TIME_S)
MEASURED = 0.4 * np.sin(3 * TIME_S - 0.1)


def write_bag(folder, plugin, packed):
    writer = Writer(folder, version=9, storage_plugin=plugin)
    if packed is not None:
        writer.set_compression(packed, CompressionFormat.ZSTD)
    kinds = STORE.types
    with writer:
        topics = [writer.add_connection(name, JOINTS, typestore=STORE) for name in ("/joint_states", "/goal")]
        for time_s, *values in zip(TIME_S, MEASURED, ASKED):
            stamp_ns = int(round(time_s * 1e9)) + 1_700_000_000_000_000_000
            stamp = kinds["builtin_interfaces/msg/Time"](sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
            header = kinds["std_msgs/msg/Header"](stamp=stamp, frame_id="")
            for topic, value in zip(topics, values):
                message = kinds[JOINTS](header, ["swing"], np.array([value]), np.array([]), np.array([]))
                writer.write(topic, stamp_ns + 1_500_000, STORE.serialize_cdr(message, JOINTS))


def write_dataset(folder, **options):
    """Two episodes in degrees, the gripper in percent."""
    names = ["elbow.pos", "swing.pos", "gripper.pos"]
    rows = [(e, k) for e in range(2) for k in range(len(TIME_S))]
    vectors = {
        name: pyarrow.array(
            [[110.0, float(np.degrees(angle[k])), 50.0] for _, k in rows], pyarrow.list_(pyarrow.float32(), 3)
        )
        for name, angle in (("observation.state", MEASURED), ("action", ASKED))
    }
    numbers = {
        "timestamp": pyarrow.array([TIME_S[k] for _, k in rows], pyarrow.float32()),
        "frame_index": pyarrow.array([k for _, k in rows], pyarrow.int64()),
        "episode_index": pyarrow.array([e for e, _ in rows], pyarrow.int64()),
    }
    os.makedirs(os.path.join(folder, "meta"))
    os.makedirs(os.path.join(folder, "data", "chunk-000"))
    table = pyarrow.table({**vectors, **numbers})
    parquet.write_table(table, os.path.join(folder, "data", "chunk-000", "file-000.parquet"), **options)
    vector = {"dtype": "float32", "shape": [3], "names": names}
    info = {"codebase_version": "v3.0", "fps": 50, "features": {name: vector for name in vectors}}
    with open(os.path.join(folder, "meta", "info.json"), "w") as file:
        json.dump(info, file)


class Recordings(unittest.TestCase):
    def imported(self, folder, recording):
        """The log of the first run, by the map that is guessed."""
        robot, draft = caudata.robot_path("xl330_pendulum"), os.path.join(folder, "map.toml")
        caudata.run("gap", "import", "--robot", robot, "--draft-map", draft, recording)
        logs = os.path.join(folder, "logs")
        caudata.run("gap", "import", "--robot", robot, "--map", draft, "--out", logs, recording)
        caudata.run("gap", "check", "--robot", robot, "--log", logs)
        return caudata.read_log(os.path.join(logs, sorted(os.listdir(logs))[0]))

    def check(self, log, tolerance):
        self.assertEqual(len(log), len(TIME_S))
        np.testing.assert_allclose(log.time_s - log.time_s[0], TIME_S, atol=1e-6)
        np.testing.assert_allclose(log["pos.swing"], MEASURED, atol=tolerance)
        np.testing.assert_allclose(log["cmd.swing"], ASKED, atol=tolerance)

    def test_bags_of_ros(self):
        for plugin, packed in (
            (StoragePlugin.SQLITE3, None),
            (StoragePlugin.SQLITE3, CompressionMode.MESSAGE),
            (StoragePlugin.MCAP, None),
            (StoragePlugin.MCAP, CompressionMode.STORAGE),
        ):
            with self.subTest(plugin=plugin, packed=packed), tempfile.TemporaryDirectory() as folder:
                bag = os.path.join(folder, "bag")
                write_bag(bag, plugin, packed)
                self.check(self.imported(folder, bag), 1e-12)

    def test_datasets_of_lerobot(self):
        for options in (
            {},
            {"compression": "zstd", "use_dictionary": False},
            {"compression": "none", "data_page_version": "2.0"},
            {"compression": "gzip"},
            {"compression": "snappy", "data_page_version": "2.0", "row_group_size": 30},
        ):
            with self.subTest(**options), tempfile.TemporaryDirectory() as folder:
                dataset = os.path.join(folder, "dataset")
                write_dataset(dataset, **options)
                # degrees in 32 bits
                self.check(self.imported(folder, dataset), 1e-6)
                self.assertEqual(len(os.listdir(os.path.join(folder, "logs"))), 2)

    def test_a_python_that_cannot_read_it_is_said(self):
        with tempfile.TemporaryDirectory() as folder:
            dataset = os.path.join(folder, "dataset")
            write_dataset(dataset)
            bare = os.path.join(folder, "python")
            with open(bare, "w") as file:
                # neither packages nor the user's own
                file.write('#!/bin/sh\nexec %s -S -E "$@"\n' % sys.executable)
            os.chmod(bare, 0o755)
            for python, said in ((bare, "needs a Python with pyarrow and numpy"), ("/no/python", "does not start")):
                with self.subTest(python=python), mock.patch.dict(os.environ, CAUDATA_PYTHON=python):
                    with self.assertRaisesRegex(caudata.ProgramError, said):
                        self.imported(folder, dataset)

    def test_a_log_as_a_table(self):
        with tempfile.TemporaryDirectory() as folder:
            csv, table, back = (os.path.join(folder, name) for name in ("a.csv", "a.parquet", "b.csv"))
            with open(csv, "w") as file:
                file.write("t,pos.swing,contact.FL\n0.0,0.5,\n0.02,,1.0\n")
            caudata.run("log", "convert", csv, "--out", table)
            read = parquet.read_table(table)
            self.assertEqual(read.column_names, ["t", "pos.swing", "contact.FL"])
            self.assertEqual(read["pos.swing"].to_pylist(), [0.5, None])
            self.assertEqual(read["t"].to_pylist(), [0.0, 0.02])
            parquet.write_table(read, table, use_dictionary=["pos.swing"])
            caudata.run("log", "convert", table, "--out", back)
            with open(back) as file:
                self.assertEqual([len(line.split(",")) for line in file], [3, 3, 3])
            again = os.path.join(folder, "c.parquet")
            caudata.run("log", "convert", back, "--out", again)
            self.assertEqual(parquet.read_table(again).to_pydict(), read.to_pydict())


if __name__ == "__main__":
    unittest.main()
