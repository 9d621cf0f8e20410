"""Logs of runs: MCAP files with one protobuf message per slot and topic.

Any MCAP reader opens them; `LogReader` reads them into NumPy arrays and checks every checksum.
"""

from hiersched.log.digest import log_digest
from hiersched.log.errors import LogError
from hiersched.log.events import Event
from hiersched.log.foreign import foreign_records, read_foreign
from hiersched.log.frame import slot_span, topic_frame
from hiersched.log.reader import LogReader
from hiersched.log.recover import Recovery, recover
from hiersched.log.schema import SCHEMA_VERSION, TOPICS, LogDims
from hiersched.log.writer import LogWriter

__all__ = [
    "LogWriter",
    "LogReader",
    "LogError",
    "LogDims",
    "Event",
    "TOPICS",
    "SCHEMA_VERSION",
    "topic_frame",
    "slot_span",
    "log_digest",
    "read_foreign",
    "foreign_records",
    "recover",
    "Recovery",
]
