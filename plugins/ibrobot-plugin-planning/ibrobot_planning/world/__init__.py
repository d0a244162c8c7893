"""The surroundings of the arm and their geometry: objects, collision checks, point clouds, the section `world`."""
