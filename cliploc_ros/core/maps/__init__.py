# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The map: landmarks, one map or several, and the files that hold them.

landmark_map
    The map, and how its file is read; landmark_details has its optional fields.
landmark_embeddings, image_rows
    What an image encoder saw of each landmark, and how crops are compared with it.
joined_map
    Several maps, searched as one.
map_file, parameter_file
    Writing a map, and reading any parameter file without ROS.
"""
