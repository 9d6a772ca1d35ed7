"""Vectorised corridor environment and PPO / PPO-LSTM. Knows sim_gateway (world, physics, LiDAR) and policy_export."""
