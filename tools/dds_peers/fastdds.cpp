// A participant with Fast DDS, of this machine alone: fastdds DOMAIN, then lines on stdin:
// "TOPIC TYPE latched|volatile" listens; "TOPIC TYPE send HEX [TIMES]" writes bytes, with their encapsulation, once a reader is
// matched: as often as told, every 50 ms.
//
// On stdout, for each writer that it finds: "W TOPIC USER_DATA", for each reader: "R TOPIC TYPE", for each message:
// "M TOPIC SIZE", and SIZE bytes as they came, with their encapsulation. It knows no types. Ends with its stdin.

#include <chrono>
#include <cstring>
#include <iostream>
#include <mutex>
#include <sstream>
#include <string>
#include <thread>
#include <vector>

#include <fastdds/dds/domain/DomainParticipant.hpp>
#include <fastdds/dds/domain/DomainParticipantFactory.hpp>
#include <fastdds/dds/domain/DomainParticipantListener.hpp>
#include <fastdds/dds/publisher/DataWriter.hpp>
#include <fastdds/dds/publisher/Publisher.hpp>
#include <fastdds/dds/subscriber/DataReader.hpp>
#include <fastdds/dds/subscriber/DataReaderListener.hpp>
#include <fastdds/dds/subscriber/SampleInfo.hpp>
#include <fastdds/dds/subscriber/Subscriber.hpp>
#include <fastdds/dds/topic/Topic.hpp>
#include <fastdds/dds/topic/TopicDataType.hpp>
#include <fastdds/dds/topic/TypeSupport.hpp>
#include <fastdds/rtps/transport/UDPv4TransportDescriptor.h>
#include <fastrtps/utils/IPLocator.h>

using namespace eprosima::fastdds::dds;
using namespace eprosima::fastrtps::rtps;
using Bytes = std::vector<unsigned char>;

static std::mutex output;

struct AnyType : TopicDataType
{
    explicit AnyType(const std::string & name)
    {
        setName(name.c_str());
        m_typeSize = 1 << 24;
        m_isGetKeyDefined = false;
        auto_fill_type_information(false);
        auto_fill_type_object(false);
    }

    bool serialize(void * data, SerializedPayload_t * payload) override
    {
        const auto & bytes = *static_cast<Bytes *>(data);
        std::memcpy(payload->data, bytes.data(), bytes.size());
        payload->length = static_cast<uint32_t>(bytes.size());
        return true;
    }

    bool deserialize(SerializedPayload_t * payload, void * data) override
    {
        static_cast<Bytes *>(data)->assign(payload->data, payload->data + payload->length);
        return true;
    }

    std::function<uint32_t()> getSerializedSizeProvider(void * data) override
    {
        return [data] {return static_cast<uint32_t>(static_cast<Bytes *>(data)->size());};
    }

    void * createData() override {return new Bytes;}

    void deleteData(void * data) override {delete static_cast<Bytes *>(data);}

    bool getKey(void *, InstanceHandle_t *, bool) override {return false;}
};

struct Printing : DataReaderListener
{
    std::string topic;

    void on_data_available(DataReader * reader) override
    {
        Bytes bytes;
        SampleInfo info;
        while (reader->take_next_sample(&bytes, &info) == ReturnCode_t::RETCODE_OK) {
            if (info.valid_data) {
                const std::lock_guard<std::mutex> guard(output);
                std::cout << "M " << topic << " " << bytes.size() << "\n";
                std::cout.write(reinterpret_cast<const char *>(bytes.data()), static_cast<std::streamsize>(bytes.size()));
                std::cout.flush();
            }
        }
    }
};

struct Discovering : DomainParticipantListener
{
    void on_publisher_discovery(DomainParticipant *, WriterDiscoveryInfo && found) override
    {
        if (found.status == WriterDiscoveryInfo::DISCOVERED_WRITER) {
            const auto & data = found.info.m_qos.m_userData.getValue();
            const std::lock_guard<std::mutex> guard(output);
            std::cout << "W " << found.info.topicName() << " " << std::string(data.begin(), data.end()) << std::endl;
        }
    }

    void on_subscriber_discovery(DomainParticipant *, ReaderDiscoveryInfo && found) override
    {
        if (found.status == ReaderDiscoveryInfo::DISCOVERED_READER) {
            const std::lock_guard<std::mutex> guard(output);
            std::cout << "R " << found.info.topicName() << " " << found.info.typeName() << std::endl;
        }
    }
};

static bool send(DomainParticipant * participant, const std::string & topic, const std::string & type, const std::string & digits, int times)
{
    DataWriterQos qos;
    qos.reliability().kind = RELIABLE_RELIABILITY_QOS;
    qos.endpoint().history_memory_policy = PREALLOCATED_WITH_REALLOC_MEMORY_MODE;
    auto writer = participant->create_publisher(PUBLISHER_QOS_DEFAULT)->create_datawriter(
        participant->create_topic(topic, type, TOPIC_QOS_DEFAULT), qos);
    if (writer == nullptr) {return false;}
    PublicationMatchedStatus matched;
    for (int tries = 0; tries < 300; ++tries) {
        writer->get_publication_matched_status(matched);
        if (matched.current_count > 0) {break;}
        std::this_thread::sleep_for(std::chrono::milliseconds(50));
    }
    std::this_thread::sleep_for(std::chrono::seconds(1));  // that the reader of the answer is known, too
    Bytes bytes;
    for (size_t at = 0; at + 1 < digits.size(); at += 2) {
        bytes.push_back(static_cast<unsigned char>(std::stoul(digits.substr(at, 2), nullptr, 16)));
    }
    bool is_written = matched.current_count > 0 && writer->write(&bytes);
    for (int time = 1; time < times && is_written; ++time) {
        std::this_thread::sleep_for(std::chrono::milliseconds(50));
        is_written = writer->write(&bytes);
    }
    return is_written;
}

int main(int count, char ** arguments)
{
    const uint32_t domain = count > 1 ? std::stoul(arguments[1]) : 0;
    DomainParticipantQos qos;
    qos.transport().use_builtin_transports = false;
    auto transport = std::make_shared<eprosima::fastdds::rtps::UDPv4TransportDescriptor>();
    transport->interfaceWhiteList.emplace_back("127.0.0.1");
    transport->receiveBufferSize = 4 << 20;
    qos.transport().user_transports.push_back(transport);
    for (uint32_t index = 0; index < 8; ++index) {
        Locator_t peer;
        IPLocator::setIPv4(peer, "127.0.0.1");
        peer.port = 7400 + 250 * domain + 10 + 2 * index;
        qos.wire_protocol().builtin.initialPeersList.push_back(peer);
    }
    qos.wire_protocol().builtin.discovery_config.leaseDuration_announcementperiod = {1, 0};

    Discovering discovering;
    auto participant = DomainParticipantFactory::get_instance()->create_participant(
        domain, qos, &discovering, StatusMask::none());
    if (participant == nullptr) {
        std::cerr << "no participant in domain " << domain << std::endl;
        return 1;
    }
    auto subscriber = participant->create_subscriber(SUBSCRIBER_QOS_DEFAULT);
    std::vector<std::unique_ptr<Printing>> printing;
    for (std::string line; std::getline(std::cin, line); ) {
        std::string topic, type, durability;
        std::string digits;
        int times = 1;
        std::istringstream(line) >> topic >> type >> durability >> digits >> times;
        TypeSupport(new AnyType(type)).register_type(participant);
        if (durability == "send") {
            if (!send(participant, topic, type, digits, times)) {std::cerr << "nothing sent to " << topic << std::endl;}
            continue;
        }
        DataReaderQos reader;
        reader.reliability().kind = RELIABLE_RELIABILITY_QOS;
        reader.durability().kind = durability == "latched" ? TRANSIENT_LOCAL_DURABILITY_QOS : VOLATILE_DURABILITY_QOS;
        reader.history().kind = KEEP_LAST_HISTORY_QOS;
        reader.history().depth = 10;
        reader.endpoint().history_memory_policy = PREALLOCATED_WITH_REALLOC_MEMORY_MODE;
        printing.push_back(std::make_unique<Printing>());
        printing.back()->topic = topic;
        if (subscriber->create_datareader(
                participant->create_topic(topic, type, TOPIC_QOS_DEFAULT), reader, printing.back().get()) == nullptr)
        {
            std::cerr << "no reader of " << topic << std::endl;
            return 1;
        }
    }
    participant->delete_contained_entities();
    DomainParticipantFactory::get_instance()->delete_participant(participant);
    return 0;
}
