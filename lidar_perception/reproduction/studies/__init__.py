"""What paper A leaves open, each question measured (reproduce --study NAME)."""

# name -> where its Experiment is; imported only on demand
STUDIES = {
    name: f"lidar_perception.reproduction.studies.{name}:STUDY"
    for name in ("configurations", "seeds", "morphology", "adaptive", "confidence", "geometry",
                 "density")
}
