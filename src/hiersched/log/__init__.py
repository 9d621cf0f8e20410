"""Logs of runs: MCAP files with one protobuf message per slot and topic.

Any MCAP reader opens them; `LogReader` reads them into NumPy arrays and checks every checksum.
"""

from hiersched.log.errors import LogError
from hiersched.log.events import Event
from hiersched.log.frame import slot_span, topic_frame
from hiersched.log.reader import LogReader, log_digest
from hiersched.log.recover import Recovery, recover
from hiersched.log.schema import SCHEMA_VERSION, TOPICS, LogDims, field_table, proto_source
from hiersched.log.writer import LogWriter

__all__ = [
    "LogWriter",
    "LogReader",
    "LogError",
    "LogDims",
    "Event",
    "TOPICS",
    "SCHEMA_VERSION",
    "field_table",
    "proto_source",
    "topic_frame",
    "slot_span",
    "log_digest",
    "recover",
    "Recovery",
]
