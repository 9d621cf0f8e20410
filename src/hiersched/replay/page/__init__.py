"""A log as one HTML page: queues, delays, robots, the allocation as an image, events."""

from hiersched.replay.page.build import write_log_page

__all__ = ["write_log_page"]
