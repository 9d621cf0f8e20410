"""Logs of runs: MCAP files with one protobuf message per slot and topic.

Any MCAP reader opens them; `LogReader` reads them into NumPy arrays and checks every checksum.
"""

from hiersched.log.errors import LogError
from hiersched.log.events import Event
from hiersched.log.reader import LogReader
from hiersched.log.schema import SCHEMA_VERSION, TOPICS, LogDims
from hiersched.log.writer import LogWriter

__all__ = ["LogWriter", "LogReader", "LogError", "LogDims", "Event", "TOPICS", "SCHEMA_VERSION"]
