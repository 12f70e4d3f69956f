"""PandaSet: semantic classes of LiDAR points, 1 to 42."""

from __future__ import annotations

from weather_aug._class_tables.table import ClassTable, all_as, numbered

PANDASET = ClassTable(
    numbered(
        (
            # Points that nobody labelled; the data set's own list starts at 1.
            "unlabelled",
            "Smoke",
            "Exhaust",
            "Spray or rain",
            "Reflection",
            "Vegetation",
            "Ground",
            "Road",
            "Lane Line Marking",
            "Stop Line Marking",
            "Other Road Marking",
            "Sidewalk",
            "Driveway",
            "Car",
            "Pickup Truck",
            "Medium-sized Truck",
            "Semi-truck",
            "Towed Object",
            "Motorcycle",
            "Other Vehicle - Construction Vehicle",
            "Other Vehicle - Uncommon",
            "Other Vehicle - Pedicab",
            "Emergency Vehicle",
            "Bus",
            "Personal Mobility Device",
            "Motorized Scooter",
            "Bicycle",
            "Train",
            "Trolley",
            "Tram / Subway",
            "Pedestrian",
            "Pedestrian with Object",
            "Animals - Bird",
            "Animals - Other",
            "Pylons",
            "Road Barriers",
            "Signs",
            "Cones",
            "Construction Signs",
            "Temporary Construction Barriers",
            "Rolling Containers",
            "Building",
            "Other Static Object",
        )
    ),
    {
        "Vegetation": "vegetation",
        "Ground": "terrain",
        **all_as("road", "Road", "Lane Line Marking", "Stop Line Marking", "Other Road Marking"),
        "Sidewalk": "sidewalk",
        "Car": "car",
        # Cityscapes counts pickups as trucks.
        **all_as("truck", "Pickup Truck", "Medium-sized Truck", "Semi-truck"),
        **all_as("motorcycle", "Motorcycle", "Motorized Scooter"),
        "Bus": "bus",
        "Bicycle": "bicycle",
        **all_as("train", "Train", "Trolley", "Tram / Subway"),
        **all_as("person", "Pedestrian", "Pedestrian with Object"),
        "Signs": "traffic sign",
        "Building": "building",
    },
    relaxed={
        "Driveway": "road",
        "Road Barriers": "fence",
        "Construction Signs": "traffic sign",
    },
)
