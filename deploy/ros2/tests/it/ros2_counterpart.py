"""ROS 2 itself as the other side: one JSON question a line on standard input, one answer a line.

{"type": ..., "cdr": hex}: those bytes go over DDS as they are to a subscription of the type; what it heard is
    published by type to a subscription of bytes. Answers the fields that were heard, the bytes, and the hash of
    the type.
{"play": file, "record": file}: every message of a bag is read, published by type, and recorded by a
    subscription of bytes into another bag.
"""

import importlib
import json
import sys
import time

import rclpy
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message

PATIENCE_S = 60
LOSSLESS = QoSProfile(reliability=ReliabilityPolicy.RELIABLE, history=HistoryPolicy.KEEP_ALL, depth=0)


def kind_of(name):
    package, middle, kind = name.split("/")
    return getattr(importlib.import_module("%s.%s" % (package, middle)), kind)


def plain(value):
    """A message as JSON can say it: bytes as numbers, what is no finite number as text."""
    if hasattr(value, "get_fields_and_field_types"):
        return {name: plain(getattr(value, name)) for name in value.get_fields_and_field_types()}
    if isinstance(value, (str, bool)):
        return value
    if isinstance(value, bytes):
        return int.from_bytes(value, "little")
    if hasattr(value, "__len__"):
        return [plain(item) for item in value]
    return value if value == value and abs(value) != float("inf") else str(value)


class Line:
    """A topic, one publisher, and one subscription that takes bytes or messages."""

    def __init__(self, node, kind, topic, raw):
        self.node, self.heard = node, []
        self.subscription = node.create_subscription(kind, topic, self.heard.append, LOSSLESS, raw=raw)
        self.publisher = node.create_publisher(kind, topic, LOSSLESS)
        self.wait(lambda: self.publisher.get_subscription_count() > 0)

    def wait(self, come):
        end = time.monotonic() + PATIENCE_S
        while not come():
            if time.monotonic() > end:
                raise TimeoutError("nothing came over DDS within %d s" % PATIENCE_S)
            rclpy.spin_once(self.node, timeout_sec=0.05)

    def send(self, message):
        count = len(self.heard)
        self.publisher.publish(message)
        self.wait(lambda: len(self.heard) > count)
        return self.heard[-1]


def carried(node, number, question):
    kind = kind_of(question["type"])
    message = Line(node, kind, "typed_%d" % number, raw=False).send(bytes.fromhex(question["cdr"]))
    line = Line(node, kind, "bytes_%d" % number, raw=True)
    info = node.get_publishers_info_by_topic("/bytes_%d" % number)[0]
    return {"fields": plain(message), "cdr": line.send(message).hex(), "hash": str(info.topic_type_hash)}


def played(node, number, question):
    lines, channels, count = {}, {}, 0
    with open(question["play"], "rb") as source, open(question["record"], "wb") as target:
        writer = Writer(target, compression=CompressionType.LZ4)
        writer.start(profile="ros2")
        for schema, channel, record in make_reader(source).iter_messages():
            topic = channel.topic
            if topic not in lines:
                lines[topic] = Line(node, kind_of(schema.name), "/play_%d%s" % (number, topic), raw=True)
                schema_id = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[topic] = writer.register_channel(topic, "cdr", schema_id)
            heard = lines[topic].send(deserialize_message(record.data, kind_of(schema.name)))
            writer.add_message(channels[topic], record.log_time, heard, record.publish_time)
            count += 1
        writer.finish()
    return {"messages": count, "topics": sorted(lines)}


def main():
    rclpy.init()
    node = rclpy.create_node("counterpart")
    for number, line in enumerate(sys.stdin):
        question = json.loads(line)
        answer = played if "play" in question else carried
        print(json.dumps(answer(node, number, question)), flush=True)


main()
