// Tracks a CSV of IMU samples with the models that `gnio export RUN` writes.
//
//   track EXPORT walk.csv positions.csv
//
// The CSV has a header and the columns time (s), gyro x, y, z (rad/s), accel x, y, z (m/s²,
// gravity included). Lie still for the first second. Each row of the result is the end of a clone
// interval: time, position x, y, z (m), their standard deviations.

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdlib>
#include <fstream>
#include <iostream>
#include <limits>
#include <map>
#include <sstream>
#include <stdexcept>
#include <string>
#include <vector>

#include <onnxruntime_cxx_api.h>

using Tensors = std::map<std::string, Ort::Value>;
using Sample = std::array<double, 7>;  // time, gyro, accel

Ort::Value tensor(const std::vector<int64_t>& shape, const std::vector<double>& values) {
  Ort::AllocatorWithDefaultOptions allocator;
  auto made = Ort::Value::CreateTensor<double>(allocator, shape.data(), shape.size());
  std::copy(values.begin(), values.end(), made.GetTensorMutableData<double>());
  return made;
}

struct Model {
  Ort::Session session;

  Model(Ort::Env& env, const Ort::SessionOptions& options, const std::string& path)
      : session(env, path.c_str(), options) {}

  // All outputs by name. Inputs are taken by name from the first source that has them.
  Tensors run(const std::vector<const Tensors*>& sources) {
    Ort::AllocatorWithDefaultOptions allocator;
    Ort::IoBinding binding(session);
    for (size_t i = 0; i < session.GetInputCount(); ++i) {
      const std::string name = session.GetInputNameAllocated(i, allocator).get();
      for (const Tensors* source : sources) {
        if (auto found = source->find(name); found != source->end()) {
          binding.BindInput(name.c_str(), found->second);
          break;
        }
      }
    }
    for (size_t i = 0; i < session.GetOutputCount(); ++i)
      binding.BindOutput(session.GetOutputNameAllocated(i, allocator).get(), allocator.GetInfo());
    session.Run(Ort::RunOptions(), binding);
    auto names = binding.GetOutputNames();
    auto values = binding.GetOutputValues();
    Tensors found;
    for (size_t i = 0; i < names.size(); ++i) found.emplace(names[i], std::move(values[i]));
    return found;
  }

  // Samples that a call takes: the first axis of `gyro`.
  size_t samples() {
    Ort::AllocatorWithDefaultOptions allocator;
    for (size_t i = 0; i < session.GetInputCount(); ++i)
      if (std::string(session.GetInputNameAllocated(i, allocator).get()) == "gyro")
        return session.GetInputTypeInfo(i).GetTensorTypeAndShapeInfo().GetShape()[0];
    throw std::runtime_error("the model has no input 'gyro'");
  }

  double said(const char* key) {
    Ort::AllocatorWithDefaultOptions allocator;
    auto metadata = session.GetModelMetadata();
    return std::stod(metadata.LookupCustomMetadataMapAllocated(key, allocator).get());
  }
};

std::vector<Sample> read(const std::string& path) {
  std::ifstream file(path);
  std::string line, cell;
  if (!std::getline(file, line)) throw std::runtime_error(path + ": cannot be read");
  std::vector<Sample> samples;
  for (size_t row = 1; std::getline(file, line); ++row) {
    if (line.find_first_not_of(" \t\r") == std::string::npos) continue;
    std::istringstream cells(line);
    Sample sample;
    for (double& value : sample) {
      char* end = nullptr;
      cell.clear();
      std::getline(cells, cell, ',');
      value = std::strtod(cell.c_str(), &end);
      const bool increases = &value != &sample[0] || samples.empty() || value > samples.back()[0];
      if (end == cell.c_str() || !std::isfinite(value) || !increases)
        throw std::runtime_error(path + " row " + std::to_string(row) + ": seven finite numbers are "
                                 "expected, with a time that increases, and found '" + line + "'");
    }
    samples.push_back(sample);
  }
  if (samples.size() < 2) throw std::runtime_error(path + ": has fewer than two samples");
  return samples;
}

// On the grid of the filter, linearly. A faster IMU wants a low-pass first.
std::vector<Sample> resample(const std::vector<Sample>& recorded, double rate) {
  std::vector<Sample> grid;
  size_t after = 1;
  for (double t = recorded.front()[0]; t <= recorded.back()[0] + 1e-6;
       t = recorded.front()[0] + grid.size() / rate) {
    while (after + 1 < recorded.size() && recorded[after][0] < t) ++after;
    const Sample &a = recorded[after - 1], &b = recorded[after];
    const double share = std::clamp((t - a[0]) / (b[0] - a[0]), 0.0, 1.0);
    Sample mixed;
    for (size_t i = 0; i < 7; ++i) mixed[i] = a[i] + share * (b[i] - a[i]);
    mixed[0] = t;
    grid.push_back(mixed);
  }
  return grid;
}

// `gyro` and `accel` of `count` samples from `first` on.
Tensors stride(const std::vector<Sample>& samples, size_t first, size_t count) {
  std::vector<double> gyro, accel;
  for (size_t i = first; i < first + count; ++i) {
    gyro.insert(gyro.end(), samples[i].begin() + 1, samples[i].begin() + 4);
    accel.insert(accel.end(), samples[i].begin() + 4, samples[i].end());
  }
  const std::vector<int64_t> shape{static_cast<int64_t>(count), 3};
  Tensors found;
  found.emplace("gyro", tensor(shape, gyro));
  found.emplace("accel", tensor(shape, accel));
  return found;
}

// What the filter step takes of the network's answer; without one, no measurement. A network with a
// frame of its own has the variances along the axes that its output `axes` (cosine, sine) names.
Tensors measured(const Tensors* answer, double log_std_min) {
  std::vector<double> displacement(3, std::numeric_limits<double>::quiet_NaN());
  std::vector<double> covariance{1, 0, 0, 0, 1, 0, 0, 0, 1};
  for (size_t i = 0; answer != nullptr && i < 3; ++i) {
    displacement[i] = answer->at("displacement").GetTensorData<float>()[i];
    const double log_std = answer->at("log_std").GetTensorData<float>()[i];
    covariance[4 * i] = std::exp(2 * std::max(log_std, log_std_min));
  }
  if (answer != nullptr && answer->count("axes") > 0) {
    const float* axes = answer->at("axes").GetTensorData<float>();
    const double c = axes[0], s = axes[1], along = covariance[0], across = covariance[4];
    covariance[0] = c * c * along + s * s * across;
    covariance[4] = s * s * along + c * c * across;
    covariance[1] = covariance[3] = c * s * (along - across);
  }
  Tensors found;
  found.emplace("displacement", tensor({3}, displacement));
  found.emplace("covariance", tensor({3, 3}, covariance));
  return found;
}

void track(const std::string& folder, const std::string& csv, const std::string& result) {
  Ort::Env env(ORT_LOGGING_LEVEL_ERROR, "track");
  Ort::SessionOptions options;
  options.SetIntraOpNumThreads(1);
  Model network(env, options, folder + "/network.onnx");
  Model start(env, options, folder + "/filter_start.onnx");
  Model window(env, options, folder + "/filter_window.onnx");
  Model step(env, options, folder + "/filter_step.onnx");
  const double rate = step.said("rate"), log_std_min = step.said("log_std_min");
  const size_t first_inferred = step.said("first_inferred"), n = step.samples();
  const size_t first_measured = step.said("first_measured");

  const auto samples = resample(read(csv), rate);
  if (samples.size() < start.samples()) throw std::runtime_error(csv + ": is too short");
  const Tensors rest = stride(samples, 0, start.samples());
  Tensors state = start.run({&rest});
  std::ofstream out(result);
  out.precision(12);
  out << "time,px,py,pz,std_x,std_y,std_z\n";
  for (size_t k = 0; (k + 1) * n <= samples.size(); ++k) {
    const Tensors imu = stride(samples, k * n, n);
    Tensors answer;
    if (k >= first_inferred) {
      const Tensors seen = window.run({&state, &imu});
      answer = network.run({&seen, &state});
    }
    const Tensors given = measured(k >= first_measured ? &answer : nullptr, log_std_min);
    Tensors after = step.run({&state, &imu, &given});
    for (Tensors* outputs : {&answer, &after})  // a network with memory gives its own arrays
      for (auto& [name, value] : *outputs)
        if (name.rfind("next.", 0) == 0)
          state.insert_or_assign("state." + name.substr(5), std::move(value));
    const double* position = after.at("pose.position").GetTensorData<double>();
    const double* covariance = after.at("pose.covariance").GetTensorData<double>();  // (15, 15)
    out << samples[0][0] + (k + 1) * n / rate;
    for (size_t i = 0; i < 3; ++i) out << "," << position[i];
    for (size_t i = 6; i < 9; ++i) out << "," << std::sqrt(covariance[15 * i + i]);
    out << "\n";
  }
}

int main(int count, char** arguments) {
  if (count != 4) {
    std::cerr << "usage: track EXPORT walk.csv positions.csv\n";
    return 2;
  }
  try {
    track(arguments[1], arguments[2], arguments[3]);
  } catch (const std::exception& error) {
    std::cerr << error.what() << "\n";
    return 2;
  }
}
