"""Roles on the nodes of a Ray cluster: places, keepers, leases, addresses that move. Only `ray_cluster` knows Ray."""
