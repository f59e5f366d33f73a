# Sourced by the tools: the tests of all that depends on the path that frames take, native or numpy.

data_path_tests=(
    tests/core/test_{aio,attacks,chaos,coherency,commit,damaged_files,freshness,hot_path,lifecycle_model,losses}.py
    tests/core/test_{new_generations,removed_files,requests,service,service_life,skin,snapshot,statistics,threads,window}.py
    tests/sdk/test_{bursts,device_stamps,error_frames,filters,full_bus,hardware_clock,identifiers,intake,known_losses}.py
    tests/sdk/test_{many_buses,pairing,patch_timing,publisher,roboskin_damage,roboskin_inertial,roboskin_kinds}.py
    tests/sdk/test_{roboskin_wire,running_driver,samples,socketcan_receive,socketcan_stamps,stamps}.py
    tests/drivers/test_{conformance,wire_formats}.py
    tests/virtual/test_faults.py
)
