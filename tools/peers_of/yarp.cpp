// A port of 192-value Vectors, as the program of a robot has it, and a reader of such a port: see tools/peers_of/yarp.py.
//
// Value i of vector n is (n + i) % 2040 / 8, so that every reader can check every vector by itself. A vector of nothing
// but 0 is blank: the driver that is served has no good values just now.
#include <yarp/os/BufferedPort.h>
#include <yarp/os/Network.h>
#include <yarp/os/Stamp.h>
#include <yarp/os/Time.h>
#include <yarp/sig/Vector.h>

#include <cstdio>
#include <string>

namespace {
constexpr int VALUES = 192, PERIOD = 2040;
constexpr double STEP = 8.0, PERIOD_S = 0.02;

bool isBlank(const yarp::sig::Vector& vector) {
    for (double value : vector) {
        if (value != 0) {
            return false;
        }
    }
    return true;
}

bool isExact(const yarp::sig::Vector& vector) {
    const int first = static_cast<int>(vector[0] * STEP);
    for (int i = 0; i < VALUES; i++) {
        if (vector[i] != (first + i) % PERIOD / STEP) {
            return false;
        }
    }
    return true;
}

int publish(const std::string& name) {
    yarp::os::BufferedPort<yarp::sig::Vector> port;
    if (!port.open(name)) {
        return 1;
    }
    std::puts("ready");
    std::fflush(stdout);
    yarp::os::Stamp stamp;
    for (int n = 0;; n++) {
        yarp::sig::Vector& vector = port.prepare();
        vector.resize(VALUES);
        for (int i = 0; i < VALUES; i++) {
            vector[i] = (n + i) % PERIOD / STEP;
        }
        stamp.update();
        port.setEnvelope(stamp);
        port.write();
        yarp::os::Time::delay(PERIOD_S);
    }
}

int read(const std::string& name, const std::string& from, const std::string& carrier) {
    yarp::os::BufferedPort<yarp::sig::Vector> port;
    if (!port.open(name)) {
        return 1;
    }
    if (!yarp::os::Network::connect(from, name, carrier)) {
        return 1;
    }
    long count = 0, inexact = 0, blank = 0;
    while (const yarp::sig::Vector* vector = port.read()) {
        count++;
        if (vector->size() == VALUES && isBlank(*vector)) {
            blank++;
        } else if (vector->size() != VALUES || !isExact(*vector)) {
            inexact++;
        }
        std::printf("%ld %ld %ld\n", count, inexact, blank);
        std::fflush(stdout);
    }
    return 0;
}
}  // namespace

int main(int count, char** words) {
    yarp::os::Network network;
    const std::string what = count > 1 ? words[1] : "";
    if (what == "publish" && count == 3) {
        return publish(words[2]);
    }
    if (what == "read" && count == 5) {
        return read(words[2], words[3], words[4]);
    }
    std::fputs("publish NAME | read NAME FROM CARRIER\n", stderr);
    return 2;
}
