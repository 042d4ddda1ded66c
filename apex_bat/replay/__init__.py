"""The central prioritized replay: buffer, sum tree, rate limiter, server and clients."""
