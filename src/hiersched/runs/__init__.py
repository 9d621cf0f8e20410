"""The stages of a study: each runs the simulator and logs every slot. The workflow calls them."""
