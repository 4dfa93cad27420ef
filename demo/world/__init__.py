# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Programs that build the demo's room, and train and measure its networks.

Run the programs from the root of the repository, as ``python -m demo.world.PROGRAM``:

make_demo_world
    Render the demo's room and fit its map.
make_worlds
    Render the rooms to train on.
train_clip, train_detector
    Train the small networks of the demo.
compare
    Compare the paper's methods in the demo's room.
class_growth
    Measure how the number of objects of one class affects each method.
"""
