"""The bat's world and ear: arenas, PyBullet world, rays, sonar, cochlea and the Gymnasium environments."""
