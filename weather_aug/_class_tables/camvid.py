"""CamVid: the 32 classes, by id and by colour, and the 11 that segmentation papers merge."""

from __future__ import annotations

from weather_aug._class_tables.table import ClassTable, all_as

CAMVID_11 = ClassTable(
    dict(
        enumerate(
            (
                "Sky",
                "Building",
                "Pole",
                "Road",
                "Pavement",
                "Tree",
                "SignSymbol",
                "Fence",
                "Car",
                "Pedestrian",
                "Bicyclist",
                "Unlabelled",
            )
        )
    )
    | {255: "Void"},
    {
        "Sky": "sky",
        "Building": "building",
        "Pole": "pole",
        "Road": "road",
        "Pavement": "sidewalk",
        "Tree": "vegetation",
        "SignSymbol": "traffic sign",
        "Fence": "fence",
        "Car": "car",
        "Pedestrian": "person",
        "Bicyclist": "rider",
    },
    other_names={
        "Column_Pole": "pole",
        "Road_marking": "road",
        "Sidewalk": "sidewalk",
        "Vegetation": "vegetation",
        "Cyclist": "rider",
        "Unlabeled": None,
    },
)

_COLOUR_BY_NAME = {
    "Animal": (64, 128, 64),
    "Archway": (192, 0, 128),
    "Bicyclist": (0, 128, 192),
    "Bridge": (0, 128, 64),
    "Building": (128, 0, 0),
    "Car": (64, 0, 128),
    "CartLuggagePram": (64, 0, 192),
    "Child": (192, 128, 64),
    "Column_Pole": (192, 192, 128),
    "Fence": (64, 64, 128),
    "LaneMkgsDriv": (128, 0, 192),
    "LaneMkgsNonDriv": (192, 0, 64),
    "Misc_Text": (128, 128, 64),
    "MotorcycleScooter": (192, 0, 192),
    "OtherMoving": (128, 64, 64),
    "ParkingBlock": (64, 192, 128),
    "Pedestrian": (64, 64, 0),
    "Road": (128, 64, 128),
    "RoadShoulder": (128, 128, 192),
    "Sidewalk": (0, 0, 192),
    "SignSymbol": (192, 128, 128),
    "Sky": (128, 128, 128),
    "SUVPickupTruck": (64, 128, 192),
    "TrafficCone": (0, 0, 64),
    "TrafficLight": (0, 64, 64),
    "Train": (192, 64, 128),
    "Tree": (128, 128, 0),
    "Truck_Bus": (192, 128, 192),
    "Tunnel": (64, 0, 64),
    "VegetationMisc": (192, 192, 0),
    "Void": (0, 0, 0),
    "Wall": (64, 192, 0),
}

# The data set itself has colours only; releases that number them count the names of the colour
# table in its own, alphabetical order.
CAMVID_32 = ClassTable(
    dict(enumerate(_COLOUR_BY_NAME)),
    {
        "Building": "building",
        "Wall": "wall",
        "Fence": "fence",
        "Column_Pole": "pole",
        "TrafficLight": "traffic light",
        "SignSymbol": "traffic sign",
        "Sky": "sky",
        "Bicyclist": "rider",
        "Train": "train",
        "MotorcycleScooter": "motorcycle",
        "Sidewalk": "sidewalk",
        **all_as("road", "Road", "LaneMkgsDriv", "LaneMkgsNonDriv"),
        **all_as("vegetation", "Tree", "VegetationMisc"),
        **all_as("person", "Pedestrian", "Child"),
        **all_as("car", "Car", "SUVPickupTruck"),
    },
    relaxed={"Truck_Bus": "truck", "RoadShoulder": "road"},
    colours=dict(enumerate(_COLOUR_BY_NAME.values())),
)
