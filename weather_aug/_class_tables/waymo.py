"""Waymo Open Dataset: camera segmentation, 0 to 28."""

from __future__ import annotations

from weather_aug._class_tables.table import ClassTable, all_as, numbered

WAYMO = ClassTable(
    numbered(
        (
            "TYPE_UNDEFINED",
            "TYPE_EGO_VEHICLE",
            "TYPE_CAR",
            "TYPE_TRUCK",
            "TYPE_BUS",
            "TYPE_OTHER_LARGE_VEHICLE",
            "TYPE_BICYCLE",
            "TYPE_MOTORCYCLE",
            "TYPE_TRAILER",
            "TYPE_PEDESTRIAN",
            "TYPE_CYCLIST",
            "TYPE_MOTORCYCLIST",
            "TYPE_BIRD",
            "TYPE_GROUND_ANIMAL",
            "TYPE_CONSTRUCTION_CONE_POLE",
            "TYPE_POLE",
            "TYPE_PEDESTRIAN_OBJECT",
            "TYPE_SIGN",
            "TYPE_TRAFFIC_LIGHT",
            "TYPE_BUILDING",
            "TYPE_ROAD",
            "TYPE_LANE_MARKER",
            "TYPE_ROAD_MARKER",
            "TYPE_SIDEWALK",
            "TYPE_VEGETATION",
            "TYPE_SKY",
            "TYPE_GROUND",
            "TYPE_DYNAMIC",
            "TYPE_STATIC",
        )
    ),
    {
        "TYPE_CAR": "car",
        "TYPE_TRUCK": "truck",
        "TYPE_BUS": "bus",
        "TYPE_BICYCLE": "bicycle",
        "TYPE_MOTORCYCLE": "motorcycle",
        "TYPE_PEDESTRIAN": "person",
        # The vehicle is part of these two.
        **all_as("rider", "TYPE_CYCLIST", "TYPE_MOTORCYCLIST"),
        "TYPE_POLE": "pole",
        "TYPE_SIGN": "traffic sign",
        "TYPE_TRAFFIC_LIGHT": "traffic light",
        # Walls and solid fences are part of it.
        "TYPE_BUILDING": "building",
        **all_as("road", "TYPE_ROAD", "TYPE_LANE_MARKER", "TYPE_ROAD_MARKER"),
        "TYPE_SIDEWALK": "sidewalk",
        "TYPE_VEGETATION": "vegetation",
        "TYPE_SKY": "sky",
    },
    relaxed={"TYPE_GROUND": "terrain"},
)
