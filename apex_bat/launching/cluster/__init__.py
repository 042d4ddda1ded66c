"""Roles on the nodes of a Ray cluster: places, keepers, leases, addresses. Only modules named `ray_` know Ray."""
