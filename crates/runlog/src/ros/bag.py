"""The messages of a bag that SQLite holds, as rosbag2_storage_sqlite3 lays them out, in the order of writing.

Arguments: the file, and the types whose bytes are wanted. For each message, little-endian: the lengths of topic and
type (u16) and of its bytes (u32), when it was received (i64, ns), and then topic, type and bytes.
"""

import sys

sys.path[:] = filter(None, sys.path)  # what lies in the working folder is not imported

import pathlib
import sqlite3
import struct

MESSAGES = """
    SELECT messages.id, topics.name, topics.type, timestamp, CASE WHEN topics.type IN (%s) THEN data END
    FROM messages LEFT JOIN topics ON topics.id = topic_id ORDER BY messages.id
"""

path, wanted = pathlib.Path(sys.argv[1]).absolute(), sys.argv[2:]
log = path.with_name(path.name + "-wal")
# Messages may still be in the log beside it. Where there is none, nothing is written beside the file.
mode = "mode=ro" if log.is_file() else "immutable=1"
try:
    file = sqlite3.connect("%s?%s" % (path.as_uri(), mode), uri=True)
    for number, topic, kind, received_ns, data in file.execute(MESSAGES % ",".join("?" * len(wanted)), wanted):
        if topic is None:
            sys.exit("message %d: is on a topic that is not listed" % number)
        topic, kind, data = topic.encode(), kind.encode(), data or b""
        head = struct.pack("<HHIq", len(topic), len(kind), len(data), received_ns)
        sys.stdout.buffer.write(head + topic + kind + data)
    sys.stdout.flush()
except (sqlite3.Error, AttributeError, TypeError, struct.error) as error:
    sys.exit("is no bag of ROS 2: %s" % error)
