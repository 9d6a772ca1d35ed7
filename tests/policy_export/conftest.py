"""Fixtures of this folder; the helpers they use are in policy_samples."""

from policy_samples import feed_forward_path, network, policy_bytes, policy_path

__all__ = ["feed_forward_path", "network", "policy_bytes", "policy_path"]
