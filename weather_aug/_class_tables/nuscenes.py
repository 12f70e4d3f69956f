"""nuScenes-lidarseg (32 classes of points) and nuImages (the same names, on pixels)."""

from __future__ import annotations

from weather_aug._class_tables.table import ClassTable, all_as, numbered

_OBJECTS = numbered(
    (
        "animal",
        "human.pedestrian.adult",
        "human.pedestrian.child",
        "human.pedestrian.construction_worker",
        "human.pedestrian.personal_mobility",
        "human.pedestrian.police_officer",
        "human.pedestrian.stroller",
        "human.pedestrian.wheelchair",
        "movable_object.barrier",
        "movable_object.debris",
        "movable_object.pushable_pullable",
        "movable_object.trafficcone",
        "static_object.bicycle_rack",
        "vehicle.bicycle",
        "vehicle.bus.bendy",
        "vehicle.bus.rigid",
        "vehicle.car",
        "vehicle.construction",
        "vehicle.emergency.ambulance",
        "vehicle.emergency.police",
        "vehicle.motorcycle",
        "vehicle.trailer",
        "vehicle.truck",
    ),
    first=1,
)
_OBJECT_CLASSES = {
    **all_as(
        "person",
        "human.pedestrian.adult",
        "human.pedestrian.child",
        "human.pedestrian.construction_worker",
        "human.pedestrian.police_officer",
    ),
    **all_as("bus", "vehicle.bus.bendy", "vehicle.bus.rigid"),
    **all_as("car", "vehicle.car", "vehicle.emergency.police"),
    "vehicle.bicycle": "bicycle",
    "vehicle.motorcycle": "motorcycle",
    "vehicle.truck": "truck",
    "flat.driveable_surface": "road",
}
_OBJECTS_RELAXED = {
    "human.pedestrian.personal_mobility": "rider",
    "movable_object.barrier": "fence",
    **all_as("truck", "vehicle.construction", "vehicle.emergency.ambulance"),
}

# Ids 25 to 30 differ between sources: the annotators' instructions put sidewalk, terrain, other,
# manmade, vegetation, other; published learning maps put what stands here. This is the order of
# the development kit's colour map, which its own test compares with the ids in category.json.
NUSCENES_LIDARSEG = ClassTable(
    {0: "noise"}
    | _OBJECTS
    | numbered(
        (
            "flat.driveable_surface",
            "flat.other",
            "flat.sidewalk",
            "flat.terrain",
            "static.manmade",
            "static.other",
            "static.vegetation",
            "vehicle.ego",
        ),
        first=24,
    ),
    _OBJECT_CLASSES
    | {
        "flat.sidewalk": "sidewalk",
        "flat.terrain": "terrain",
        "static.vegetation": "vegetation",
    },
    # Manmade mixes buildings with walls, poles, signs and traffic lights.
    relaxed=_OBJECTS_RELAXED | {"static.manmade": "building"},
)

NUIMAGES = ClassTable(
    {0: "background"} | _OBJECTS | {24: "flat.driveable_surface", 31: "vehicle.ego"},
    _OBJECT_CLASSES,
    relaxed=_OBJECTS_RELAXED,
)
