# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A map file with comments and all styles of YAML, for the tests of the studio."""

TEXT = """\
# The office on the second floor.   Measured by hand.
other_node:
  ros__parameters:
    rate: 5.0   # Hz
/**:
  ros__parameters:
    map:
      frame_id: map
      landmarks:
        # the red one, from the kitchen
        cup_1:
          label: 'a red cup'   # Ann's
          class_id: cup
          center: [1.0, 2.0, 0.5]   # from the plan
          semi_axes: [0.05, 0.05, 0.08]
          orientation: [0.0, 0.0, 0.0, 1.0]

        # shelf
        book_1:
          labels:
            text: ["a thick book", "a novel"]
            weight: [0.7, 0.3]
          class_id: book
          center:
            - 2.0
            - 2.0
            - 0.5
          semi_axes: [0.1, 0.15, 0.03]
          orientation: [0.0, 0.0, 0.0, 1.0]
          position_sigma: 0.01
          class_weights: {book: 0.9, tv: 0.1}
        plant_1:
          label: >
            a plant
            in a pot
          class_id: plant
          center: [3.0, 2.0, 0.5]
          semi_axes: [0.1, 0.15, 0.3]
          orientation: [0.0, 0.0, 0.0, 1.0]
    map_file: ''  # the relocalizer's own
"""
