"""Program that subscribes to topics with rclpy, and prints each message as a line of JSON.

``python -m tests.ros_subscriber TOPIC=MESSAGE …``; the first line says that the subscriptions exist.
"""

import base64
import importlib
import json
import sys
import time

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile


def main():
    rclpy.init()
    node = rclpy.create_node("ertis_test")
    for each in sys.argv[1:]:
        topic, _, message = each.partition("=")
        package, _, name = message.split("/")
        kind = getattr(importlib.import_module(f"{package}.msg"), name)
        profile = QoSProfile(depth=1000, durability=DurabilityPolicy.VOLATILE)
        node.create_subscription(kind, topic, lambda data, topic=topic: emit(topic, data), profile, raw=True)
    emit_line({"ready": True})
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    executor.spin()


def emit(topic, data):
    emit_line({"topic": topic, "received_ns": time.time_ns(), "cdr": base64.b64encode(data).decode()})


def emit_line(content):
    sys.stdout.write(json.dumps(content) + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main()
