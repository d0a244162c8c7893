"""The SO-101 in MuJoCo: hardware, cameras, scenes, a scripted pick policy and a viewer for ibrobot."""
