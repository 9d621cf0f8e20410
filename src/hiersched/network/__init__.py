"""Traffic, queues, allocation, schedulers and the Lyapunov terms."""
