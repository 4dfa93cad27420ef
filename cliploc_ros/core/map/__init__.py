# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The map: landmarks, joined maps, map files, and indices.

landmark_map
    The map, its landmarks by class, and the reader of its file; landmark_details has the optional
    fields.
landmark_embeddings
    Image embeddings of each landmark, and their comparison with crops.
joined_map
    Several maps, searched as one.
map_file, parameter_file
    Write a map, and read any parameter file without ROS.
similarities, pairs, culling
    Find landmarks by similarity of their labels, by pairs, and by position.
visibility
    Find the landmarks that an image should show.
presence
    Whether objects are still in their places: for the watch and for updates.
"""
