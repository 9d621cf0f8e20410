"""The models of channel, link, traffic, queue and plant: one file each."""
