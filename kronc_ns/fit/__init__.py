"""From a scene to a solution: where to start, attempts, repair, the car's frame, the walk, the verdict."""
