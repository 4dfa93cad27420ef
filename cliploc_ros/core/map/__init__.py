# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The map: landmarks, one map or several, their files, and their indices.

landmark_map
    The map, its landmarks by class, and how its file is read; landmark_details has its optional
    fields.
landmark_embeddings
    Image embeddings of each landmark, and their comparison with crops.
joined_map
    Several maps, searched as one.
map_file, parameter_file
    Write a map, read it fast, and read any parameter file without ROS.
similarities, pairs, culling
    The landmarks by similarity of their labels, by pairs, and by place.
visibility
    The landmarks that an image should show, and those that are gone.
"""
