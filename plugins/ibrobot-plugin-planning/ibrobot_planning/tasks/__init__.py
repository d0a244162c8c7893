"""Tasks: files of steps, such as motions, grasps and policies, which are checked as a whole and then performed."""
