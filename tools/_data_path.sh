# Sourced by the tools: the tests of all that depends on the path that frames take, native or numpy.

both_paths_tests=( # these take both by themselves (the fixture data_path)
    tests/core/test_{chaos,coherency,commit,hot_path,lifecycle_model,look,losses,new_generations,service,service_life,skin}.py
    tests/core/test_statistics.py
)
data_path_tests=(
    tests/core/test_{aio,attacks,damaged_files,freshness,removed_files,requests,snapshot,threads,window}.py
    tests/sdk/test_{bursts,device_stamps,error_frames,filters,full_bus,hardware_clock,identifiers,intake,known_losses}.py
    tests/sdk/test_{many_buses,pairing,patch_timing,publisher,roboskin_damage,roboskin_inertial,roboskin_kinds}.py
    tests/sdk/test_{roboskin_wire,running_driver,samples,socketcan_receive,socketcan_stamps,stamps}.py
    tests/drivers/test_{conformance,wire_formats}.py
    tests/serial/test_{device_drivers,serial_driver}.py
    tests/virtual/test_faults.py
)
