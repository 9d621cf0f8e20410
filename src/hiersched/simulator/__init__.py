"""The co-simulator: network and robots in one slot loop over a batch of worlds."""

from hiersched.simulator.loop_gains import Gains
from hiersched.simulator.record import SlotFields, SlotRecord
from hiersched.simulator.setup import SlotConstants, SlotState
from hiersched.simulator.simulator import Simulator

__all__ = ["Gains", "Simulator", "SlotConstants", "SlotFields", "SlotRecord", "SlotState"]
